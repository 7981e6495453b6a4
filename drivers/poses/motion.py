"""Poses by time: interpolated between samples, extrapolated for a bounded while."""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semantic_mapper.geometry import interpolate_pose, pose_distance
from semantic_mapper.types import Float64

_BASELINE_NS = 20_000_000  # velocities are those over at least so long, where there are such poses

Miss = Literal["empty", "before", "gap", "stale"]


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """One sample: T_parent_child (4, 4) at ``stamp_ns``, position uncertainty in metres (0 = not known)."""

    stamp_ns: int
    T: Float64
    sigma: float = 0.0


def apart(T_a: Float64, T_b: Float64) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    moved_m, turned = pose_distance(T_a, T_b)
    return moved_m, float(np.rad2deg(turned))


class PoseTrack:
    """The last ``keep`` poses of something that moves, at any time in between. Not for several threads at once.

    Nothing is interpolated between two samples further apart than ``max_gap_ns``; the motion of the last one is taken
    to go on for ``max_ahead_ns``.
    """

    def __init__(self, keep: int, max_gap_ns: int, max_ahead_ns: int) -> None:
        self._samples: deque[StampedPose] = deque(maxlen=keep)
        self._max_gap_ns = max_gap_ns
        self._max_ahead_ns = max_ahead_ns

    @property
    def newest_ns(self) -> int:
        """Stamp of the last sample; -1 without any."""
        return self._samples[-1].stamp_ns if self._samples else -1

    def add(self, sample: StampedPose) -> bool:
        """Append a sample; False, and nothing done, where it is not later than the last one."""
        if self._samples and sample.stamp_ns <= self._samples[-1].stamp_ns:
            return False
        self._samples.append(sample)
        return True

    def at(self, stamp_ns: int) -> StampedPose | Miss:
        """The pose at a moment, or why it is missing: "empty": no samples; "before": earlier than the first one that
        is kept; "gap": between two that are too far apart; "stale": too long after the last one."""
        if not self._samples:
            return "empty"
        stamps = [s.stamp_ns for s in self._samples]
        after = bisect_left(stamps, stamp_ns)
        if after < len(stamps) and stamps[after] == stamp_ns:
            return self._samples[after]
        if after == 0:
            return "before"
        if after == len(stamps):
            return self._ahead(stamp_ns)
        a, b = self._samples[after - 1], self._samples[after]
        if b.stamp_ns - a.stamp_ns > self._max_gap_ns:
            return "gap"
        fraction = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        return StampedPose(stamp_ns, interpolate_pose(a.T, b.T, fraction), max(a.sigma, b.sigma))

    def _ahead(self, stamp_ns: int) -> StampedPose | Miss:
        last = self._samples[-1]
        alone = len(self._samples) < 2 or last.stamp_ns - self._samples[-2].stamp_ns > self._max_gap_ns
        if alone or stamp_ns - last.stamp_ns > self._max_ahead_ns:
            return "stale"  # one pose alone shows no motion
        # From poses that are not close together: of two that are, the noise would be taken for motion.
        earlier = [s for s in self._samples if last.stamp_ns - s.stamp_ns <= self._max_gap_ns][:-1]
        before = next((s for s in reversed(earlier) if last.stamp_ns - s.stamp_ns >= _BASELINE_NS), earlier[0])
        fraction = (stamp_ns - before.stamp_ns) / (last.stamp_ns - before.stamp_ns)
        T = interpolate_pose(before.T, last.T, fraction)
        # That the motion goes on is a guess, as wrong as the motion could have changed: half of what it adds.
        guessed = 0.5 * float(np.linalg.norm(T[:3, 3] - last.T[:3, 3]))
        return StampedPose(stamp_ns, T, float(np.hypot(last.sigma, guessed)) if last.sigma > 0 else 0.0)
