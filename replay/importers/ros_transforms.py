"""The tree of coordinate frames that ROS calls tf: who sits where on whom, and since when.

``T_parent_child`` of each frame is fixed, or changes over time and is interpolated between its two neighbours.
"""

from dataclasses import dataclass, field
from itertools import chain, combinations_with_replacement, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose, pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import MATCH_NS
from semantic_mapper.replay.importers.ros_bags import frame_name, position_and_rotation
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
    """Poses over time, at least one, or, where they are ``fixed``, the last of them at any time.

    Stamps may come in any order; of one stamp the last row, tx ty tz qx qy qz qw, counts. ``doubled`` is how many have
    the stamp of another one and differ from it.
    """

    def __init__(self, stamps_ns: list[int], rows: list[tuple[float, ...]], *, fixed: bool = False) -> None:
        order = np.argsort(stamps_ns, kind="stable")
        self._all_stamps_ns: NDArray[np.int64] = np.array(stamps_ns, np.int64)[order]
        self._all_rows = np.array(rows, np.float64)[order]
        again = np.diff(self._all_stamps_ns) == 0
        last = np.append(~again, True)
        self.fixed = fixed
        self.doubled = int((again & np.any(np.diff(self._all_rows, axis=0) != 0, axis=1)).sum())
        self.stamps_ns: NDArray[np.int64] = self._all_stamps_ns[last]  # (N,) rising
        self._rows = self._all_rows[last]

    def at(self, stamp_ns: int, within_ns: int = MATCH_NS) -> Float64 | None:
        """Pose (4, 4) at a time, see ``pose_at``."""
        if self.fixed:
            return pose_matrix(self._rows[-1, :3], self._rows[-1, 3:])
        return pose_at(stamp_ns, self.stamps_ns, self._rows, MAX_GAP_NS, within_ns)

    def differs(self, other: "Track", *, unless_apart: bool) -> bool:
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
        if self.fixed:
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
class PoseSeries:
    """Poses of one frame as one source publishes them, in the order of recording."""

    stamps_ns: list[int] = field(default_factory=list[int])
    received_ns: list[int] = field(default_factory=list[int])  # stand for the stamps of those that have none
    rows: list[tuple[float, ...]] = field(default_factory=list[tuple[float, ...]])  # tx ty tz qx qy qz qw
    refused: int = 0  # that hold NaN or no rotation

    def add(self, message: Any, received_ns: int) -> bool:
        """Take in a message with a pose; whether that can be used."""
        p, q = position_and_rotation(message)
        row = tuple(float(value) for value in (p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        if not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > MAX_NORM_ERROR:
            self.refused += 1
            return False
        self.stamps_ns.append(stamp_of(message.header))
        self.received_ns.append(received_ns)
        self.rows.append(row)
        return True

    def track(self, name: str, notices: list[str], *, fixed: bool = False) -> Track | None:
        """The poses, None without any; ``notices`` gets sentences on what is odd about them."""
        if self.refused:
            notices.append(f"{name}: {counted(self.refused, 'pose')} left out: they hold NaN or no rotation")
        if not self.rows:
            return None
        if fixed:
            self.stamps_ns = list(range(len(self.rows)))  # the last that was recorded counts
        else:
            notices += fill_stamps(self.stamps_ns, self.received_ns, name)
        track = Track(self.stamps_ns, self.rows, fixed=fixed)
        if track.doubled:
            notices.append(f"{name}: {counted(track.doubled, 'pose')} with the stamp of another one; the last counts")
        return track


class TransformTree:
    """All transforms of a bag; ``close`` it once they are in."""

    def __init__(self) -> None:
        self._series: dict[str, dict[str, PoseSeries]] = {}  # by child and source, as of ``add``
        self._parents: dict[str, set[str]] = {}
        self._sources: dict[str, dict[str, Track]] = {}
        self._tracks: dict[str, Track] = {}  # of all sources that move a frame, or else of the last one

    def add(self, stamped: Any, source: str, received_ns: int) -> None:
        """Take in a ``geometry_msgs/TransformStamped``. The source is "TOPIC of PROGRAM"; tf_static's are fixed."""
        child, parent = frame_name(stamped.child_frame_id), frame_name(stamped.header.frame_id)
        if child in ("", parent):
            return
        if self._series.setdefault(child, {}).setdefault(source, PoseSeries()).add(stamped, received_ns):
            self._parents.setdefault(child, set()).add(parent)

    def close(self) -> list[str]:
        """Sort what was taken in; sentences on what is odd about it."""
        notices: list[str] = []
        for child, given in self._series.items():
            tracks = {
                source: series.track(f"tf of '{child}'", notices, fixed=_topic(source).endswith("tf_static"))
                for source, series in given.items()
            }
            sources = self._sources[child] = {source: track for source, track in tracks.items() if track is not None}
            moving = [given[source] for source, track in sources.items() if not track.fixed]
            if moving:
                stamps_ns = chain.from_iterable(series.stamps_ns for series in moving)
                rows = chain.from_iterable(series.rows for series in moving)
                self._tracks[child] = Track(list(stamps_ns), list(rows))
            elif sources:
                self._tracks[child] = [*sources.values()][-1]
        return notices

    def check(self, target: str, source: str) -> None:
        """Refuse two truths about a transform between two frames.

        Raises ImportSourceError: two programs publish one transform and differ.
        """
        for child in ({*self.way_up(source)} ^ {*self.way_up(target)}) & self._tracks.keys():
            what = f"tf: '{child}' on '{next(iter(self._parents[child]))}'"
            for (a, track), (b, other) in combinations_with_replacement(self._sources[child].items(), 2):
                one, another = (track, other) if other.fixed else (other, track)  # a fixed one has no times
                if one.differs(another, unless_apart=_topic(a) == _topic(b)):
                    raise ImportSourceError(
                        f"{what} is published by {a} and, otherwise, by {b}: record the true one alone, cut the bag "
                        "between the two, or keep only one in it (`rosbag filter`, `ros2 bag convert`)"
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

    def lookup(self, target: str, source: str, stamp_ns: int, within_ns: int = MATCH_NS) -> Float64 | None:
        """``T_target_source`` (4, 4) at a time; None where tf tells nothing of that time, or the two do not meet."""
        up, down = self.way_up(source), self.way_up(target)
        if up[-1] != down[-1]:
            return None
        T_meeting: list[Float64] = []  # from the frame in which the two ways meet to source and target
        for way, other in ((up, down), (down, up)):
            T_meeting.append(np.eye(4))
            for frame in way:
                if frame not in other:
                    T_parent_frame = self._tracks[frame].at(stamp_ns, within_ns)
                    if T_parent_frame is None:
                        return None
                    T_meeting[-1] = T_parent_frame @ T_meeting[-1]
        return invert_pose(T_meeting[1]) @ T_meeting[0]


def _topic(source: str) -> str:
    return source.partition(" of ")[0]


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
