"""Times of boxes whose poses are by frame of a drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.replay.box_values import BoxFile
from semantic_mapper.replay.importers.kitti360 import SOURCE as KITTI360_SOURCE
from semantic_mapper.replay.log.sequence import Log


def with_times(boxes: BoxFile, path: Path, log: Log) -> tuple[BoxFile, list[int]]:
    """Boxes with poses by frame of a drive of KITTI-360, with the times of these frames in a log of it instead.

    Poses at frames that the log lacks are dropped, and boxes without any other.

    Args:
        boxes: Of a file.
        path: Of the file, for errors.
        log: Imported from KITTI-360.

    Returns:
        The boxes, and the ids of those that were dropped.

    Raises:
        ConfigError: the log is of something else, or has none of the frames at which any box is.
    """
    if all(box.frames is None for box in boxes.primitives):
        return boxes, []
    if not log.info.source.startswith(KITTI360_SOURCE):
        raise ConfigError(
            f"{path}: boxes have poses by frame of a drive of KITTI-360, and {log.path} is of '{log.info.source}'; "
            "give the log that `import` made of the drive, or delete these boxes"
        )
    times: dict[int, int] = {}
    for envelope, _ in log.frame_parts():
        times.setdefault(envelope.seq, envelope.stamp_ns)
    timed = [_timed(box, times) for box in boxes.primitives]
    dropped = [box.id for box, new in zip(boxes.primitives, timed, strict=True) if new is None]
    kept = tuple(new for new in timed if new is not None)
    if not kept:
        raise ConfigError(
            f"{path}: all boxes move, and {log.path} has none of the frames of the drive at which they are"
        )
    return replace(boxes, primitives=kept), dropped


def _timed(box: Primitive, times: Mapping[int, int]) -> Primitive | None:
    if box.frames is None:
        return box
    stamps = tuple(sorted({times[number]: pose for number, pose in box.frames if number in times}.items()))
    return replace(box, frames=None, stamps=stamps, T_world_box=stamps[0][1]) if stamps else None
