"""From corrected poses of some frames to those of all frames.

A pose graph gives new poses for its keyframes alone. A frame between two of them in time moves with both: with C_a and
C_b the motions ``T_new @ T_old^-1`` of its neighbours and s the part of the time between them, its rotation is turned
by the rotation s of the way from R_a to R_b (slerp), and its position p goes to ``(1 - s) C_a p + s C_b p``. Blending
where the two motions take the camera, not their translations, makes the result the same wherever the world's origin is:
blended translations would be off by (turn)^2 / 8 times the distance to the origin. A frame before the first given one
moves with the first. A frame after the last moves with it only where the caller says so (``until_ns``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semantic_mapper.geometry import interpolate_pose, invert_pose, transform
from semantic_mapper.types import Float64

ALWAYS = 2**63 - 1  # later than any stamp

# By stamp_ns, or by (camera_id, stamp_ns) where cameras share stamps: T_world_camera (4, 4).
CorrectedPoses = Mapping[int, Float64] | Mapping[tuple[str, int], Float64]


@dataclass(frozen=True, slots=True)
class CorrectionStatus:
    """Where corrections stand.

    Args:
        running: A rebuild is under way; the map in use is still the old one.
        done, total: Frames of the history that the rebuild has gone through, and all.
        disk_bytes: Of the history's frames, and of the journal of the map.
        completed: Corrections that are in the map in use.
        poses: Given by these, all together.
        frozen: Frames that have left the history; corrections do not reach them.
        lost: Frames that could not be read from disk again, and so are in the map no more after a rebuild.
        failure: Why the last correction was given up; empty where it was not.
    """

    running: bool
    done: int
    total: int
    disk_bytes: int
    completed: int
    poses: int
    frozen: int
    lost: int
    failure: str

    @property
    def left(self) -> int:
        """Frames that the rebuild has still to go through."""
        return self.total - self.done if self.running else 0


class PosePair(NamedTuple):
    """The pose of one frame before and after, both T_world_camera (4, 4) float64 in the map's world.

    ``world`` is the one that the frame came in; see ``PosedFrame``.
    """

    camera_id: str
    stamp_ns: int
    old: Float64
    new: Float64
    world: int = 0


class PoseCorrection:
    """How a correction moves frames. All cameras are taken to sit on one body: they follow the same motion in time.

    A frame moves with given poses of its own world alone: a camera that came back in another world was found in the map
    by itself.

    Args:
        pairs: At least one. Where several cameras have the same stamp, the first by name speaks for the others.
        until_ns: Frames later than the last pair, up to this stamp, move with the last pair; the frames after it were
            posed in the corrected world already. ``ALWAYS``: all of them, those to come as well.
    """

    def __init__(self, pairs: Sequence[PosePair], until_ns: int) -> None:
        self.until_ns = until_ns
        self._given: Mapping[tuple[str, int], Float64] = {(p.camera_id, p.stamp_ns): p.new for p in pairs}
        motions: dict[int, dict[int, Float64]] = {}
        for pair in sorted(pairs, key=lambda p: (p.stamp_ns, p.camera_id)):
            motions.setdefault(pair.world, {}).setdefault(pair.stamp_ns, _motion(pair))
        self._motions = {
            world: (np.array(list(of_world), np.int64), list(of_world.values())) for world, of_world in motions.items()
        }

    def __len__(self) -> int:
        """Poses given."""
        return len(self._given)

    @property
    def last_motions(self) -> dict[int, Float64]:
        """(4, 4) ``T_new @ T_old^-1`` of the last given pose of each world."""
        return {world: motions[-1] for world, (_, motions) in self._motions.items()}

    def place(self, camera_id: str, stamp_ns: int, T_world_camera: Float64, world: int = 0) -> Float64:
        """The corrected pose (4, 4) of a frame; the very one that was given, where it was."""
        given = self._given.get((camera_id, stamp_ns))
        if given is not None:
            return given
        if world not in self._motions:
            return T_world_camera
        stamps, motions = self._motions[world]
        after = int(np.searchsorted(stamps, stamp_ns))
        if after == len(stamps):
            return T_world_camera if stamp_ns > self.until_ns else move(motions[-1], T_world_camera)
        if after == 0 or stamps[after] == stamp_ns:
            return move(motions[after], T_world_camera)
        fraction = (stamp_ns - int(stamps[after - 1])) / int(stamps[after] - stamps[after - 1])
        return _between(motions[after - 1], motions[after], fraction, T_world_camera)


def move(motion: Float64, T_world_camera: Float64) -> Float64:
    """``motion @ T_world_camera``; no motion leaves the pose as it is, to the bit."""
    return T_world_camera if np.array_equal(motion, np.eye(4)) else motion @ T_world_camera


def _motion(pair: PosePair) -> Float64:
    """T_new @ T_old^-1, its rotation made orthonormal, so that rounding errors of poses do not add up."""
    if np.array_equal(pair.new, pair.old):
        return np.eye(4)
    motion = pair.new @ invert_pose(pair.old)
    u, _, vt = np.linalg.svd(motion[:3, :3])
    motion[:3, :3] = u @ vt
    motion[:3, 3] = pair.new[:3, 3] - motion[:3, :3] @ pair.old[:3, 3]
    return motion


def _between(a: Float64, b: Float64, fraction: float, T_world_camera: Float64) -> Float64:
    if np.array_equal(a, b):
        return move(a, T_world_camera)
    out = np.eye(4)
    out[:3, :3] = interpolate_pose(a, b, fraction)[:3, :3] @ T_world_camera[:3, :3]
    position = T_world_camera[:3, 3]
    out[:3, 3] = (1 - fraction) * transform(a, position) + fraction * transform(b, position)
    return out
