"""Pseudo labels for ``finetune --kind panoptic``: of a folder, of weights, or the log's own images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import structlog

from semantic_mapper.config import PanopticConfig
from semantic_mapper.errors import ConfigError, FrameError, LabelError, LogError
from semantic_mapper.fields.checkpoint import anchor_from_frame
from semantic_mapper.fields.panoptic import Panoptic, box_config
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.console import FrameProgress
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.boxes import BoxFile, check_classes
from semantic_mapper.replay.label_folder import LabelFolder, open_label_folder
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.types import PosedFrame

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PseudoLabels:
    """Where label images come from.

    Args:
        label_set: Of them.
        of: The frame, by number in the log, with its pseudo label; None as a label where there is none.
        source: For people.
        train_stamps_ns: Frames whose true labels those who made them have learned from.
        once_all_are_seen: A frame and its label, once ``of`` has seen all of them.
    """

    label_set: LabelSet
    of: Callable[[PosedFrame, int], PosedFrame]
    source: str
    train_stamps_ns: frozenset[int] = frozenset()
    once_all_are_seen: Callable[[PosedFrame], PosedFrame] = lambda frame: frame


def open_pseudo_labels(log: Log, pseudo: Path | None) -> PseudoLabels:
    """The pseudo labels of a log.

    Args:
        log: The log.
        pseudo: Folder of label images, or weights; None = the log's own label images, else the shipped weights.

    Raises:
        LabelError, LogError, WeightsError: they cannot be read.
    """
    if pseudo is not None and pseudo.is_dir():
        folder = open_label_folder(pseudo, log)
        return PseudoLabels(folder.label_set, lambda f, n: _of_folder(folder, f, n), str(pseudo))
    if pseudo is None and log.info.label_set is not None and any(e.has_label for e, _ in log.frame_parts()):
        return PseudoLabels(log.info.label_set, lambda frame, _: frame, "the log's own label images")
    mapper = Mapper.load(pseudo)
    mapper.voxel_map.note_scale(log.info.scale_known)
    source = f"the map that {mapper.weights_path.name} makes of the frames"
    stamps = mapper.checkpoint.train_stamps_ns
    return PseudoLabels(
        mapper.label_set, lambda f, _: _rendered(mapper, f), source, stamps, lambda f: _cast_back(mapper, f)
    )


def read_pseudo_labelled(
    log: Log,
    labels: PseudoLabels,
    as_given: Callable[[PosedFrame], PosedFrame],
    count: int,
    width: int,
    stop: StopRequest,
    bar: FrameProgress,
) -> list[PosedFrame]:
    """Frames of a log at working width with their pseudo labels: ``count`` at most (0 = all), evenly spread.

    A frame whose label image is missing or cannot be used gives its colours alone; these are counted.

    Raises:
        LogError: no frame has a pseudo label.
        KeyboardInterrupt: a stop request came.
    """
    frames: list[PosedFrame] = []
    reasons: list[str] = []
    count = min(count or len(log), len(log))
    bar.start(len(log))
    for number in sorted({round(i * (len(log) - 1) / max(count - 1, 1)) for i in range(count)}):
        bar.set(number + 1, "reading frames and pseudo labels")
        if stop:
            raise KeyboardInterrupt
        try:
            frame = as_given(log.frame(number))
        except (LogError, FrameError) as error:
            reasons.append(str(error))
            continue
        try:
            labelled = labels.of(frame, number)
            if labelled.label is not None:
                labels.label_set.to_channels(labelled.label, f"frame seq={frame.seq}")
        except (LogError, LabelError, FrameError) as error:
            reasons.append(str(error))
            labelled = replace(frame, label=None)
        small = anchor_from_frame(labelled, width)
        frames.append(replace(small, label_is_pseudo=labelled.label_is_pseudo and labelled.label is not None))
    if not any(f.label is not None for f in frames):
        raise LogError(f"{log.path}: no frame has a pseudo label ({reasons[0] if reasons else labels.source})")
    if reasons:
        _log.warning("frames_without_pseudo_label", count=len(reasons), reason=reasons[0])
    return [labels.once_all_are_seen(frame) for frame in frames]


def boxed_field(boxes: BoxFile, path: Path, label_set: LabelSet, uncovered: str) -> Panoptic:
    """An empty field with the boxes.

    Raises:
        ConfigError: a class that the label set lacks, or no box.
    """
    check_classes(boxes, label_set, path)
    if not boxes.primitives:
        raise ConfigError(f"{path}: holds no box; draw some, or take `query MAP instances`")
    config = PanopticConfig(
        boxes=tuple(box_config(p) for p in boxes.primitives),
        merge=dict(boxes.merge),
        uncovered="empty" if uncovered == "empty" else "stuff",
    )
    return Panoptic(config, label_set)


def _of_folder(folder: LabelFolder, frame: PosedFrame, number: int) -> PosedFrame:
    return replace(folder.labelled(frame, number), label_is_pseudo=True)


def _rendered(mapper: Mapper, frame: PosedFrame) -> PosedFrame:
    label = mapper.step(replace(frame, label=None, label_is_pseudo=False)).label
    return replace(frame, label=label, label_is_pseudo=True)


def _cast_back(mapper: Mapper, frame: PosedFrame) -> PosedFrame:
    """A frame with the labels of the map, and its own where the map has none: many views err less than one."""
    if frame.label is None:
        return frame
    seen = mapper.voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label
    return replace(frame, label=np.where(seen == mapper.label_set.ignore_id, frame.label, seen))
