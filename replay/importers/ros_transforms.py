"""The tree of coordinate frames that ROS calls tf: who sits where on whom, and since when.

``T_parent_child`` of each frame is fixed, or changes over time and is interpolated between its two neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import interpolate_pose, invert_pose, pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.types import Float64

WORLDS = ("map", "world", "odom")  # names of a world by REP 105 and habit, the preferred first
MAX_NORM_ERROR = 0.1  # of a unit quaternion; more is no rotation
MAX_GAP_NS = 1_000_000_000  # over a longer gap nothing is interpolated


class Track:
    """Poses over time.

    Args:
        stamps_ns: In any order; of one stamp the last pose counts.
        rows: tx ty tz qx qy qz qw of each.

    Attributes:
        doubled: How many poses have the stamp of another one, and are different.
        back: How often stamps go back.
    """

    def __init__(self, stamps_ns: list[int], rows: list[tuple[float, ...]]) -> None:
        self.back = sum(b < a for a, b in pairwise(stamps_ns))
        last: dict[int, tuple[float, ...]] = {}
        self.doubled = 0
        for stamp_ns, row in zip(stamps_ns, rows, strict=True):
            self.doubled += last.setdefault(stamp_ns, row) != row
            last[stamp_ns] = row
        by_stamp = dict(sorted(last.items()))
        self.stamps_ns: NDArray[np.int64] = np.array(list(by_stamp), np.int64)
        self._rows = np.array(list(by_stamp.values()), np.float64).reshape(-1, 7)

    def oddities(self, name: str) -> list[str]:
        """Sentences on what is odd about the poses, for people."""
        found: list[str] = []
        if self.doubled:
            found.append(f"{name}: {counted(self.doubled, 'pose')} with the stamp of another one; the last counts")
        if self.back:
            found.append(f"{name}: stamps go back {counted(self.back, 'time')}; poses are sorted by them")
        return found

    def at(self, stamp_ns: int, within_ns: int) -> Float64 | None:
        """Pose (4, 4) at a time; None where there are no poses round it.

        Args:
            stamp_ns: When.
            within_ns: How far before the first, after the last, or from one at a gap, the nearest still counts.
        """
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        before = after - 1
        if after < len(self.stamps_ns) and self.stamps_ns[after] == stamp_ns:
            return self._pose(after)
        if before >= 0 and after < len(self.stamps_ns):
            gap = int(self.stamps_ns[after] - self.stamps_ns[before])
            if gap <= MAX_GAP_NS:
                fraction = (stamp_ns - int(self.stamps_ns[before])) / gap
                return interpolate_pose(self._pose(before), self._pose(after), fraction)
        near = [i for i in (before, after) if 0 <= i < len(self.stamps_ns)]
        best = min(near, key=lambda i: abs(int(self.stamps_ns[i]) - stamp_ns), default=None)
        if best is None or abs(int(self.stamps_ns[best]) - stamp_ns) > within_ns:
            return None
        return self._pose(best)

    def _pose(self, index: int) -> Float64:
        return pose_matrix(self._rows[index, :3], self._rows[index, 3:])


class TransformTree:
    """All transforms of a bag; ``close`` it once they are in.

    Attributes:
        refused: How many transforms were left out since they hold NaN or no rotation.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._parents: dict[str, set[str]] = {}
        self._fixed: dict[str, Float64] = {}
        self._moving: dict[str, tuple[list[int], list[tuple[float, ...]]]] = {}
        self._tracks: dict[str, Track] = {}

    def add(self, transforms: Iterable[Any], *, fixed: bool) -> None:
        """Take in the ``geometry_msgs/TransformStamped`` of one message; ``fixed`` of tf_static."""
        for stamped in transforms:
            row = pose_row(stamped.transform.translation, stamped.transform.rotation)
            child, parent = frame_name(stamped.child_frame_id), frame_name(stamped.header.frame_id)
            if row is None or not child or child == parent:
                self.refused += 1
                continue
            self._parents.setdefault(child, set()).add(parent)
            if fixed:
                self._fixed[child] = pose_matrix(np.array(row[:3]), np.array(row[3:]))
            else:
                stamps, rows = self._moving.setdefault(child, ([], []))
                stamps.append(stamp_of(stamped.header))
                rows.append(row)

    def close(self) -> list[str]:
        """Sort what was taken in; sentences on what is odd about it."""
        self._tracks = {child: Track(*found) for child, found in self._moving.items()}
        self._moving.clear()
        return [said for child, track in self._tracks.items() for said in track.oddities(f"tf of '{child}'")]

    def moving_above(self, frame: str, world: str) -> list[tuple[str, Track]]:
        """The transforms between a frame and a world that change over time, as 'parent to child'."""
        way = self.way_up(frame)
        way = way[: way.index(world) + 1] if world in way else way
        return [(f"'{up}' to '{down}'", self._tracks[down]) for down, up in pairwise(way) if down in self._tracks]

    def way_up(self, frame: str) -> list[str]:
        """The frame, the one it sits on, and so on to the root.

        Raises:
            ImportSourceError: a frame sits on two others, or the frames go round in a circle.
        """
        way = [frame]
        while way[-1] in self._parents:
            parents = sorted(self._parents[way[-1]])
            if len(parents) > 1:
                raise ImportSourceError(
                    f"tf says that '{way[-1]}' sits on {' and on '.join(parents)}: two programs publish it; record one"
                )
            if parents[0] in way:
                raise ImportSourceError(f"tf goes round in a circle: {' on '.join([*way, parents[0]])}")
            way.append(parents[0])
        return way

    def reaches(self, a: str, b: str) -> bool:
        """Whether the two frames are in one tree."""
        return self.way_up(a)[-1] == self.way_up(b)[-1]

    def lookup(self, target: str, source: str, stamp_ns: int, within_ns: int) -> Float64 | None:
        """``T_target_source`` (4, 4) at a time; None where tf tells nothing of that time, or the two do not meet."""
        up, down = self.way_up(source), self.way_up(target)
        meeting = next((frame for frame in up if frame in down), None)
        if meeting is None:
            return None
        T_meeting_source = self._climb(up[: up.index(meeting)], stamp_ns, within_ns)
        T_meeting_target = self._climb(down[: down.index(meeting)], stamp_ns, within_ns)
        if T_meeting_source is None or T_meeting_target is None:
            return None
        return invert_pose(T_meeting_target) @ T_meeting_source

    def _climb(self, way: list[str], stamp_ns: int, within_ns: int) -> Float64 | None:
        """From the parent of the last frame of ``way`` to its first."""
        T = np.eye(4)
        for frame in way:
            track = self._tracks.get(frame)
            step = self._fixed.get(frame) if track is None else track.at(stamp_ns, within_ns)
            if step is None:
                return None
            T = step @ T
        return T


def frame_name(name: str) -> str:
    """As ROS 2 writes it: ROS 1 begins some names with a slash."""
    return name.lstrip("/")


def stamp_of(header: Any) -> int:
    """Nanoseconds of a ``std_msgs/Header``."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def pose_row(position: Any, rotation: Any) -> tuple[float, ...] | None:
    """tx ty tz qx qy qz qw of two messages; None where they hold NaN or no rotation."""
    row = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    if not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > MAX_NORM_ERROR:
        return None
    return tuple(float(value) for value in row)
