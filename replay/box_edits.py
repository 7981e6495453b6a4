"""Changes to files of boxes: each function takes what a file says and returns what the changed one says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive, resized
from semantic_mapper.labels import STUFF_NAMES
from semantic_mapper.replay.boxes import MAX_ID, BoxFile
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
        """Take boxes out."""
        gone = {self._find(i).id for i in ids}
        self._set(tuple(p for p in self.boxes.primitives if p.id not in gone))

    def reclass(self, box_id: int, class_name: str) -> None:
        """Give a box another class. Whether it is a thing is as of other boxes of that class, else by its name."""
        alike = [p.thing for p in self.boxes.primitives if p.class_name == class_name and p.id != box_id]
        thing = alike[0] if alike else class_name not in STUFF_NAMES
        if not class_name:
            raise ConfigError(f"{self.path}, box {box_id}: a class has a name")
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
        if not (self._finite(box_id, size) > 0).all():
            raise ConfigError(f"{self.path}, box {box_id}: sizes must be above 0 m, got {size.tolist()}")
        self._change(box_id, lambda box: resized(box, size))

    def duplicate(self, box_id: int) -> int:
        """Put a copy of a box where it is, under the least free id above all others, which is returned."""
        box = self._find(box_id)
        new = max(p.id for p in self.boxes.primitives) + 1
        if new > MAX_ID:
            raise ConfigError(f"{self.path}, box {box_id}: a copy would have id {new}, above {MAX_ID}")
        self._set((*self.boxes.primitives, replace(box, id=new)))
        return new

    def add_time(self, box_id: int, at_ns: int) -> None:
        """Say that a box was there at another time, with the pose of the time nearest to it.

        One that stood still is known at that time alone from then on.
        """
        if at_ns < 0:
            raise ConfigError(f"{self.path}, box {box_id}: a time must not be below 0 ns, got {at_ns}")
        box = self._find(box_id)
        known = box.stamps or ()
        if any(stamp == at_ns for stamp, _ in known):
            raise ConfigError(f"{self.path}, box {box_id}: has a pose at {at_ns} ns already; move that one")
        pose = min(known, key=lambda entry: abs(entry[0] - at_ns))[1] if known else box.T_world_box
        stamps = tuple(sorted((*known, (at_ns, pose)), key=lambda entry: entry[0]))
        self._change(box_id, lambda box: replace(box, stamps=stamps, T_world_box=stamps[0][1]))

    def _moved(self, box: Primitive, move: Callable[[Float64], Float64], at_ns: int | None) -> Primitive:
        if box.stamps is None:
            if at_ns is not None:
                raise ConfigError(f"{self.path}, box {box.id}: stands still, so that it has no pose at {at_ns} ns")
            return replace(box, T_world_box=move(box.T_world_box))
        times = [stamp for stamp, _ in box.stamps]
        if at_ns is not None and at_ns not in times:
            known = _listed(times)
            raise ConfigError(f"{self.path}, box {box.id}: has no pose at {at_ns} ns, but at {known}")
        stamps = tuple((t, move(pose) if at_ns in (None, t) else pose) for t, pose in box.stamps)
        return replace(box, stamps=stamps, T_world_box=stamps[0][1])

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
        self._find(box_id)
        self._set(tuple(change(box) if box.id == box_id else box for box in self.boxes.primitives))

    def _set(self, primitives: tuple[Primitive, ...]) -> None:
        self.boxes = replace(self.boxes, primitives=primitives)


def _listed(numbers: Sequence[int]) -> str:
    rest = len(numbers) - MAX_LISTED
    return ", ".join(map(str, numbers[:MAX_LISTED])) + (f" and {rest} others" if rest > 0 else "")
