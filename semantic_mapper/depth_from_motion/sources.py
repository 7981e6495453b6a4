"""Which other frames a frame is matched with: those that see the same surface from as far aside as matching likes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semantic_mapper.depth_from_motion.views import PreparedView
from semantic_mapper.geometry import invert_pose, project, transform
from semantic_mapper.types import Float32, Float64

BASELINES = (0.06, 0.10, 0.15, 0.22)  # wanted way aside, in depths of what is seen
LEAST_BASELINE, MOST_BASELINE = 0.02, 0.5  # beyond these a frame tells nothing of depth, or looks too different
LEAST_OVERLAP = 0.4  # fraction of the reference that a source must see
OVERLAP_COST = 1.5  # of no overlap at all, against a baseline that is off by a factor of e
SAME_SIDE_COST = 0.25  # of a source on the same side as all that are chosen
GRID = 6  # points a side that stand for the reference


def choose_sources(
    reference: PreparedView, candidates: Sequence[PreparedView], count: int, depth_m: Float32 | None, usual_m: float
) -> list[PreparedView]:
    """At most ``count`` of the candidates; none where the camera only turned or stood still.

    Args:
        candidates: Other frames of the same camera.
        depth_m: (h, w) what is known of the reference's depth, 0 = none.
        usual_m: Depth where nothing is known.
    """
    points = _grid_points(reference, depth_m, usual_m)
    if not candidates:
        return []
    relations = [_relation(reference, candidate, points) for candidate in candidates]
    baseline, overlap, side = (np.array(part) for part in zip(*relations, strict=True))
    usable = (baseline >= LEAST_BASELINE) & (baseline <= MOST_BASELINE) & (overlap >= LEAST_OVERLAP)
    chosen: list[int] = []
    for wanted in _spread_over(BASELINES, count):
        free = [k for k in np.flatnonzero(usable) if k not in chosen]
        if not free:
            break
        cost = [
            abs(np.log(baseline[k] / wanted))
            + OVERLAP_COST * (1 - overlap[k])
            + (SAME_SIDE_COST * float(np.mean([side[k] @ side[c] for c in chosen])) if chosen else 0.0)
            for k in free
        ]
        chosen.append(int(free[int(np.argmin(cost))]))
    return [candidates[k] for k in chosen]


def _spread_over(values: Sequence[float], count: int) -> Float64:
    """``count`` values between the first and the last, in equal ratios where there are more than these."""
    positions = np.linspace(0, len(values) - 1, count) if count > 1 else np.array([(len(values) - 1) / 2])
    return np.exp(np.interp(positions, np.arange(len(values)), np.log(values)))


def _grid_points(reference: PreparedView, depth_m: Float32 | None, usual_m: float) -> Float64:
    """Points (N, 3) of the reference's frame, at depths that are known or usual."""
    k = reference.intrinsics
    v, u = np.meshgrid(
        np.linspace(0, k.height - 1, GRID + 2)[1:-1].round().astype(int),
        np.linspace(0, k.width - 1, GRID + 2)[1:-1].round().astype(int),
        indexing="ij",
    )
    z = np.full(u.shape, usual_m)
    if depth_m is not None and (depth_m > 0).any():
        here = depth_m[v, u]
        z = np.where(here > 0, here, np.median(depth_m[depth_m > 0]))
    return np.stack(((u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z), -1).reshape(-1, 3)


def _relation(reference: PreparedView, other: PreparedView, points: Float64) -> tuple[float, float, Float64]:
    """Baseline in depths, as parallax shows it (motion along the view counts little); overlap; direction aside."""
    T_other_reference = invert_pose(other.T_world_camera) @ reference.T_world_camera
    p = transform(T_other_reference, points)
    ahead = p[:, 2] > 0.05 * points[:, 2]
    k = other.intrinsics
    side = T_other_reference[:3, :3].T @ -T_other_reference[:3, 3]  # where the other is, seen from the reference
    length = float(np.linalg.norm(side))
    direction = side / length if length > 0 else side
    if not ahead.any():
        return 0.0, 0.0, direction
    uv = project(p[ahead], k)
    inside = (uv >= 0).all(1) & (uv[:, 0] <= k.width - 1) & (uv[:, 1] <= k.height - 1)
    turned = p[ahead] - T_other_reference[:3, 3]
    shift = p[ahead, :2] / p[ahead, 2:] - turned[:, :2] / np.maximum(turned[:, 2:], 1e-6)
    baseline = float(np.median(np.linalg.norm(shift[inside], axis=1))) if inside.any() else 0.0
    return baseline, float(inside.sum() / len(points)), direction
