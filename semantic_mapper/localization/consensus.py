"""Several frames that were found in a map, each by itself: whether they say the same of where the map is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semantic_mapper.geometry import invert_pose, pose_distance, transform
from semantic_mapper.types import Float64

AGREEING = 3  # frames that must say the same
_SAME_M, _SAME_RAD = 0.08, np.deg2rad(3.0)  # what they may differ by
_RIVAL = 0.5  # of those that agree: so many that say something else are too many
_LOOKED_AT = np.array([(0, 0, 0), (-1, -0.75, 2), (1, -0.75, 2), (-1, 0.75, 2), (1, 0.75, 2)], np.float64)  # (5, 3)
_SPREAD_M, _ROUNDS = 0.02, 5  # of the fit of those that agree


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A frame that was found.

    Args:
        T_map_world: (4, 4) where that puts the world of its pose.
        T_world_camera: (4, 4) its pose there.
        inliers: Features that agree.
    """

    T_map_world: Float64
    T_world_camera: Float64
    inliers: int


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """What sightings say together.

    Args:
        agreeing: The largest group that says the same.
        refusal: Why it is not believed; empty where it is.
    """

    agreeing: tuple[Sighting, ...]
    refusal: str


def sighting(T_map_camera: Float64, T_world_camera: Float64, inliers: int) -> Sighting:
    """A frame of this pose that was found at that one."""
    return Sighting(T_map_camera @ invert_pose(T_world_camera), T_world_camera, inliers)


def agreeing_with(one: Sighting, others: Sequence[Sighting]) -> list[Sighting]:
    """Those that say the same as ``one`` of where both cameras were; itself, too, if it is among them."""
    return [other for other in others if _agree(one, other)]


def find_consensus(seen: Sequence[Sighting]) -> Consensus:
    """What most sightings say, if enough do, and no others that agree with each other say something else."""
    best = _largest_group(seen)
    rival = _largest_group([s for s in seen if not agreeing_with(s, best)])
    refusal = ""
    if len(best) < AGREEING:
        refusal = f"{len(best)} of {AGREEING} frames agree on it"
    elif 2 * len(best) <= len(seen):
        refusal = f"{len(best)} of {len(seen)} frames that were found agree, more than half have to"
    elif len(rival) > _RIVAL * len(best):
        refusal = f"{len(best)} frames say one thing and {len(rival)} another, as of places that look alike"
    return Consensus(tuple(best), refusal)


def agreed(agreeing: Sequence[Sighting]) -> Float64:
    """T_map_world (4, 4) that fits all of those that agree best: it takes what their cameras look at to where they say.

    Those that are far from the others count for less.
    """
    old = np.concatenate([transform(s.T_world_camera, _LOOKED_AT) for s in agreeing])
    new = np.concatenate([transform(s.T_map_world @ s.T_world_camera, _LOOKED_AT) for s in agreeing])
    weights = np.ones(len(agreeing))
    T = np.eye(4)
    for _ in range(_ROUNDS):
        w = np.repeat(weights / weights.sum() / len(_LOOKED_AT), len(_LOOKED_AT))
        a, b = w @ old, w @ new
        u, _, vt = np.linalg.svd((new - b).T @ ((old - a) * w[:, None]))
        T[:3, :3] = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
        T[:3, 3] = b - T[:3, :3] @ a
        off = np.linalg.norm(transform(T, old) - new, axis=1).reshape(len(agreeing), -1)
        weights = 1 / (1 + (off**2).mean(axis=1) / _SPREAD_M**2)
    return T


def _largest_group(seen: Sequence[Sighting]) -> list[Sighting]:
    """The most that agree with one of them; earlier ones first if equal."""
    return max((agreeing_with(one, seen) for one in seen), key=len, default=[])


def _agree(a: Sighting, b: Sighting) -> bool:
    for pose in (a.T_world_camera, b.T_world_camera):
        moved_m, turned = pose_distance(a.T_map_world @ pose, b.T_map_world @ pose)
        if moved_m > _SAME_M or turned > _SAME_RAD:
            return False
    return True
