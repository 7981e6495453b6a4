"""Changes to files of boxes. A changed box is checked as one that is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.fields.primitives import Primitive, moved, resized
from semantic_mapper.replay.box_values import MAX_ID, BoxFile, is_thing
from semantic_mapper.replay.boxes import check_box, usable
from semantic_mapper.replay.importers.kitti360 import SOURCE as KITTI360_SOURCE
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.types import Float64

MAX_LISTED = 20  # ids that an error names


class BoxEditor:
    """The boxes of a file, to be changed one after the other.

    Boxes are named by their ids. Distances are metres, angles radians.

    Args:
        path: Of the file, for errors.
        boxes: What it says.

    Raises:
        ConfigError: of all its methods, naming the file and the box: there is no box of that id, or a value that a box
            cannot have.
    """

    def __init__(self, path: Path, boxes: BoxFile) -> None:
        self.path = path
        self.boxes = boxes

    def delete(self, ids: Sequence[int]) -> None:
        """Take boxes out, those that cannot be used as well; of JSON none of these may be left."""
        bad = {b.id for b in self.boxes.bad}
        gone = {i if i in bad else self._find(i).id for i in ids}
        kept = tuple(p for p in self.boxes.primitives if p.id not in gone)
        left = tuple(b for b in self.boxes.bad if b.id not in gone)
        self.boxes = usable(self.path, replace(self.boxes, primitives=kept, bad=left))

    def reclass(self, box_id: int, class_name: str) -> None:
        """Give a box another class. Whether it is a thing is as of other boxes of that class, else by its name."""
        alike = [p.thing for p in self.boxes.primitives if p.class_name == class_name and p.id != box_id]
        thing = alike[0] if alike else is_thing(class_name)
        self._change(box_id, lambda box: replace(box, class_name=class_name, thing=thing))

    def move(self, box_id: int, by: Float64, at_ns: int | None = None) -> None:
        """Shift a box by (3,) metres along the axes of the world, at one of its times or at all."""
        shift = np.eye(4)
        shift[:3, 3] = self._finite(box_id, by)
        self._change(box_id, lambda box: self._moved(box, lambda pose: shift @ pose, at_ns))

    def turn(self, box_id: int, angle: float, at_ns: int | None = None) -> None:
        """Turn a box round its own z axis, anticlockwise seen from its top, at one of its times or at all."""
        c, s = np.cos(self._finite(box_id, angle)), np.sin(angle)
        turn = np.array(((c, -s, 0, 0), (s, c, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), np.float64)
        self._change(box_id, lambda box: self._moved(box, lambda pose: pose @ turn, at_ns))

    def resize(self, box_id: int, size: Float64) -> None:
        """Give a box another size (3,) along its own axes; its middle stays."""
        new = self._finite(box_id, size)
        self._change(box_id, lambda box: resized(box, new))

    def duplicate(self, box_id: int) -> int:
        """Put a copy of a box where it is, under the least free id above all others, which is returned."""
        box = self._find(box_id)
        new = max(p.id for p in self.boxes.primitives) + 1
        if new > MAX_ID:
            raise ConfigError(f"{self.path}, box {box_id}: a copy would have id {new}, above {MAX_ID}")
        self._set((*self.boxes.primitives, replace(box, id=new)))
        return new

    def add_time(self, box_id: int, at_ns: int) -> int:
        """Say that a box was there at another time, with the pose of the time nearest to it.

        One that stood still is known at that time alone from then on.

        Returns:
            Its times now.
        """
        box = self._find(box_id)
        self._refuse_frames(box)
        known = box.stamps or ()
        if any(stamp == at_ns for stamp, _ in known):
            raise ConfigError(f"{self.path}, box {box_id}: has a pose at {at_ns} ns already; move that one")
        pose = min(known, key=lambda entry: abs(entry[0] - at_ns))[1] if known else box.T_world_box
        stamps = tuple(sorted((*known, (at_ns, pose)), key=lambda entry: entry[0]))
        self._change(box_id, lambda box: replace(box, stamps=stamps, T_world_box=stamps[0][1]))
        return len(stamps)

    def _moved(self, box: Primitive, move: Callable[[Float64], Float64], at_ns: int | None) -> Primitive:
        if at_ns is None:
            return moved(box, move)
        self._refuse_frames(box)
        if box.stamps is None:
            raise ConfigError(f"{self.path}, box {box.id}: stands still, so that it has no pose at {at_ns} ns")
        times = [stamp for stamp, _ in box.stamps]
        if at_ns not in times:
            known = _listed(times)
            raise ConfigError(f"{self.path}, box {box.id}: has no pose at {at_ns} ns, but at {known}")
        stamps = tuple((t, move(pose) if at_ns == t else pose) for t, pose in box.stamps)
        return replace(box, stamps=stamps, T_world_box=stamps[0][1])

    def _refuse_frames(self, box: Primitive) -> None:
        if box.frames is not None:
            raise ConfigError(
                f"{self.path}, box {box.id}: has poses by frame and no times; give it those of a log first: "
                "`boxes FILE times LOG`"
            )

    def _finite(self, box_id: int, value: Float64 | float) -> Float64:
        if not np.isfinite(value).all():
            raise ConfigError(f"{self.path}, box {box_id}: values must be numbers, got {value}")
        return np.asarray(value, np.float64)

    def _find(self, box_id: int) -> Primitive:
        for box in self.boxes.primitives:
            if box.id == box_id:
                return box
        ids = [box.id for box in self.boxes.primitives]
        has = f"it has {_listed(ids)}" if ids else "it has none"
        raise ConfigError(f"{self.path}: has no box {box_id}; {has}")

    def _change(self, box_id: int, change: Callable[[Primitive], Primitive]) -> None:
        new = change(self._find(box_id))
        try:
            check_box(new)
        except (ConfigError, PoseError) as error:
            raise ConfigError(f"{self.path}, box {box_id}: {error}; nothing is changed") from error
        self._set(tuple(new if box.id == box_id else box for box in self.boxes.primitives))

    def _set(self, primitives: tuple[Primitive, ...]) -> None:
        self.boxes = replace(self.boxes, primitives=primitives)


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


def _listed(numbers: Sequence[int]) -> str:
    rest = len(numbers) - MAX_LISTED
    return ", ".join(map(str, numbers[:MAX_LISTED])) + (f" and {rest} others" if rest > 0 else "")
