"""The tree of coordinate frames that ROS calls tf: who sits where on whom, and since when.

``T_parent_child`` of each frame is fixed, or changes over time and is interpolated between its two neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose, pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import MATCH_NS
from semantic_mapper.replay.importers.ros_bags import frame_name
from semantic_mapper.replay.importers.tables import MAX_NORM_ERROR
from semantic_mapper.replay.importers.tum import pose_at
from semantic_mapper.types import Float64

WORLD_FRAMES = ("map", "world", "odom")  # names of a world by REP 105 and habit, the preferred first
MAX_GAP_NS = 1_000_000_000  # over a longer gap nothing is interpolated
_SAME = 1e-3  # of a transform's entries; two that are published may differ by it
# How two sources that take turns show, in poses whose unit is metres and radians (see Track.jump_m).
_JUMP_M = 0.02  # of a pose from the line between its neighbours; less does no harm
_SMOOTHER = 0.15  # fraction of that jump within which each source is smooth; noise stays above 0.35
_DETOUR = 1.25  # length of the way over the distance; poses that are published several times each stay at 1
_WINDOW = 80  # poses that are judged together


class Track:
    """Poses over time, or, where they are ``fixed``, the last of them at any time.

    Stamps may come in any order; of one stamp the last row, tx ty tz qx qy qz qw, counts. ``doubled`` is how many have
    the stamp of another one and differ from it.
    """

    def __init__(self, stamps_ns: list[int], rows: list[tuple[float, ...]], *, fixed: bool = False) -> None:
        stamps = np.array(stamps_ns, np.int64)
        order = np.argsort(stamps, kind="stable")
        self._all_stamps_ns: NDArray[np.int64] = stamps[order]
        self._all_rows = np.array(rows, np.float64).reshape(-1, 7)[order]
        again = np.diff(self._all_stamps_ns) == 0
        self.fixed = fixed
        self.doubled = int((again & np.any(np.diff(self._all_rows, axis=0) != 0, axis=1)).sum())
        last = np.append(~again, [True] * bool(rows))
        self.stamps_ns: NDArray[np.int64] = self._all_stamps_ns[last]  # (N,) rising
        self._rows = self._all_rows[last]

    def at(self, stamp_ns: int, within_ns: int = MATCH_NS) -> Float64 | None:
        """Pose (4, 4) at a time, see ``pose_at``."""
        if self.fixed:
            return pose_matrix(self._rows[-1, :3], self._rows[-1, 3:])
        return pose_at(stamp_ns, self.stamps_ns, self._rows, MAX_GAP_NS, within_ns)

    def differs(self, other: Track, *, unless_apart: bool) -> bool:
        """Whether another source tells the same poses otherwise.

        ``unless_apart``: one after the other is no contradiction, since a program was started again.
        """
        some = slice(None, None, max(1, len(self._rows) // 1000))
        pairs = [
            (pose_matrix(row[:3], row[3:]), other.at(int(stamp_ns), 0))
            for stamp_ns, row in zip(self.stamps_ns[some], self._rows[some], strict=True)
        ]
        apart = [np.abs(mine - its).max() for mine, its in pairs if its is not None]
        if not apart:
            return not unless_apart
        return bool(max(apart) > _SAME if self.fixed or other.fixed else np.quantile(apart, 0.9) > _JUMP_M)

    def jump_m(self) -> float:
        """How far the poses jump to and fro between two sources that take turns, in metres (or radians); 0 = not.

        Each pose is compared with the line between two others. Where the next ones are far off it, but of the next few
        a pair fits, one source wrote the pose and the pair, another the poses between. Noise has no such pairs, and
        poses that are published several times each make no detours. One source may have 3 times the rate of the other.
        """
        if self.fixed or not len(self._all_rows):
            return 0.0
        rotations = Rotation.from_quat(self._all_rows[:, 3:]).as_matrix()
        x = np.hstack((self._all_rows[:, :3], rotations[:, :, :2].reshape(-1, 6)))
        reach = 4 if len(x) >= _WINDOW // 2 else 2
        i = np.arange(reach, len(x) - reach)
        if len(i) < 2 * reach:
            return 0.0
        off = np.array([[self._off_line(x, i, j, k) for k in range(1, reach + 1)] for j in range(1, reach + 1)])
        steps = np.append(0, np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1)))
        detour = (steps[i + reach] - steps[i - reach]) / (np.linalg.norm(x[i + reach] - x[i - reach], axis=1) + 1e-9)
        next_ones, best = off[0, 0], off.min(axis=(0, 1))
        for start in range(0, max(len(i) - _WINDOW, 0) + 1, _WINDOW // 2):
            part = slice(start, start + _WINDOW)
            jump = float(np.median(next_ones[part]))
            smooth = np.quantile(best[part], 0.9) < _SMOOTHER * jump
            if jump > _JUMP_M and smooth and np.median(detour[part]) > _DETOUR:
                return jump
        return 0.0

    def _off_line(self, x: Float64, i: NDArray[np.intp], j: int, k: int) -> Float64:
        """Distance (N,) of poses ``x[i]`` from the line between those j before and k after them."""
        t = self._all_stamps_ns
        gap = t[i + k] - t[i - j]
        fraction = np.where(gap > 0, (t[i] - t[i - j]) / np.maximum(gap, 1), 0.5)[:, None]
        return np.linalg.norm(x[i] - (1 - fraction) * x[i - j] - fraction * x[i + k], axis=1)


@dataclass(slots=True)
class _Published:
    """What one source publishes of where one frame sits."""

    topic: str
    stamps_ns: list[int] = field(default_factory=list[int])
    rows: list[tuple[float, ...]] = field(default_factory=list[tuple[float, ...]])
    received_ns: list[int] = field(default_factory=list[int])
    track: Track = field(init=False)  # once all are in

    @property
    def fixed(self) -> bool:
        return self.topic.endswith("tf_static")


class TransformTree:
    """All transforms of a bag; ``close`` it once they are in."""

    def __init__(self) -> None:
        self._refused = 0  # transforms that hold NaN or no rotation
        self._published: dict[str, dict[str, _Published]] = {}  # by child and source
        self._parents: dict[str, set[str]] = {}
        self._tracks: dict[str, Track] = {}  # of all sources that move a frame, or else of the last one

    def add(self, transforms: Iterable[Any], topic: str, program: str, received_ns: int) -> None:
        """Take in the ``geometry_msgs/TransformStamped`` of one message.

        Those of a topic tf_static are fixed. ``program`` published it (empty = not known), at ``received_ns``, which
        stands for the stamps of those that have none.
        """
        source = f"{topic} of {program}" if program else topic
        for stamped in transforms:
            row = pose_row(stamped.transform.translation, stamped.transform.rotation)
            child, parent = frame_name(stamped.child_frame_id), frame_name(stamped.header.frame_id)
            if row is None or not child or child == parent:
                self._refused += 1
                continue
            self._parents.setdefault(child, set()).add(parent)
            given = self._published.setdefault(child, {}).setdefault(source, _Published(topic))
            given.stamps_ns.append(stamp_of(stamped.header))
            given.received_ns.append(received_ns)
            given.rows.append(row)

    def close(self) -> list[str]:
        """Sort what was taken in; sentences on what is odd about it."""
        notices: list[str] = []
        if self._refused:
            notices.append(f"{self._refused} transforms of tf are left out: they hold NaN or no rotation")
        for child, sources in self._published.items():
            for given in sources.values():
                if given.fixed:
                    given.stamps_ns = list(range(len(given.rows)))  # the last that was recorded counts
                else:
                    notices += fill_stamps(given.stamps_ns, given.received_ns, f"tf of '{child}'")
                given.track = Track(given.stamps_ns, given.rows, fixed=given.fixed)
                notices += doubled_notice(given.track, f"tf of '{child}'")
            moving = [given for given in sources.values() if not given.fixed] or [*sources.values()][-1:]
            stamps_ns = [stamp for given in moving for stamp in given.stamps_ns]
            rows = [row for given in moving for row in given.rows]
            self._tracks[child] = Track(stamps_ns, rows, fixed=moving[0].fixed)
        return notices

    def check(self, target: str, source: str) -> None:
        """Refuse two truths about a transform between two frames.

        Raises ImportSourceError: two programs publish one transform and differ.
        """
        for child in {*self.way_up(source)} ^ {*self.way_up(target)}:
            if child not in self._published:
                continue
            what = f"tf: '{child}' on '{next(iter(self._parents[child]))}'"
            sources = self._published[child]
            for name, given in sources.items():
                if given.fixed and given.track.differs(given.track, unless_apart=True):
                    raise ImportSourceError(
                        f"{what} is fixed, but {name} says two things: cut the bag between them, or record the true "
                        "one alone"
                    )
            for (a, given), (b, other) in combinations(sources.items(), 2):
                one, another = (given, other) if other.fixed else (other, given)  # a fixed one has no times
                if one.track.differs(another.track, unless_apart=given.topic == other.topic):
                    raise ImportSourceError(
                        f"{what} is published by {a} and, otherwise, by {b}: record the true one alone, or keep "
                        "only it in the bag (`rosbag filter`, `ros2 bag convert`)"
                    )
            if jump := self._tracks[child].jump_m():
                raise ImportSourceError(
                    f"{what} jumps to and fro by {jump:.2g} m or rad: two programs publish it; stop one (such as the "
                    "odometry of the wheels next to a filter) and record again, or name a topic of poses: --topic "
                    "pose=NAME"
                )

    def moving_above(self, frame: str, world: str) -> list[tuple[str, Track]]:
        """The transforms between a frame and a world that change over time, as 'parent to child'."""
        way = self.way_up(frame)
        way = way[: way.index(world) + 1] if world in way else way
        return [
            (f"'{up}' to '{down}'", self._tracks[down]) for down, up in pairwise(way) if not self._tracks[down].fixed
        ]

    def way_up(self, frame: str) -> list[str]:
        """The frame, the one it sits on, and so on to the root.

        Raises ImportSourceError: a frame sits on two others, or the frames go round in a circle.
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

    def lookup(self, target: str, source: str, stamp_ns: int, within_ns: int = MATCH_NS) -> Float64 | None:
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
            step = self._tracks[frame].at(stamp_ns, within_ns)
            if step is None:
                return None
            T = step @ T
        return T


def stamp_of(header: Any) -> int:
    """Nanoseconds of a ``std_msgs/Header``."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def fill_stamps(stamps_ns: list[int], received_ns: list[int], name: str) -> list[str]:
    """Put the time of receipt where a stamp is 0, which no stamp is; a sentence on it, if need be.

    A simulated clock begins at 0, so there it is one.
    """
    if any(0 < stamp < received / 2 for stamp, received in zip(stamps_ns, received_ns, strict=True)):
        return []
    missing = [i for i, stamp in enumerate(stamps_ns) if not stamp]
    for i in missing:
        stamps_ns[i] = received_ns[i]
    if not missing:
        return []
    return [f"{name}: {counted(len(missing), 'message')} without a stamp; the time of receipt stands for it"]


def doubled_notice(track: Track, name: str) -> list[str]:
    """A sentence on two poses of one stamp; empty without any."""
    if not track.doubled:
        return []
    return [f"{name}: {counted(track.doubled, 'pose')} with the stamp of another one; the last counts"]


def pose_row(position: Any, rotation: Any) -> tuple[float, ...] | None:
    """tx ty tz qx qy qz qw of two messages; None where they hold NaN or no rotation."""
    row = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    if not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > MAX_NORM_ERROR:
        return None
    return tuple(float(value) for value in row)
