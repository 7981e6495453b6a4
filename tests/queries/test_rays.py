"""Rays through a snapshot against the map's own ray cast and against geometry."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.geometry import look_at
from semantic_mapper.queries.rays import cast_rays, nearest_corners, ray_cast
from tests.mapping.rendered_views import INTRINSICS, ray_directions
from tests.queries.random_map import random_map
from tests.queries.scene import BALL, CUP, MIDDLE, RADIUS, poses, seen, whole, whole_map
from tests.queries.test_surface import dense

POSE = look_at(MIDDLE + np.array([0.8, 0.9, 0.7]), MIDDLE, np.array([0.0, 0.0, 1.0]))


def test_a_view_is_that_of_the_map() -> None:
    mine, theirs = ray_cast(whole(), POSE, INTRINSICS, 5.0), whole_map().ray_cast(POSE, INTRINSICS)
    hit = (mine.depth_m > 0) & (theirs.depth_m > 0)
    assert hit.mean() > 0.6 and ((mine.depth_m > 0) == (theirs.depth_m > 0)).mean() > 0.998
    off = np.abs(mine.depth_m - theirs.depth_m)[hit]
    assert np.quantile(off, 0.98) < 0.001
    assert (mine.label == theirs.label)[hit].mean() > 0.97  # there interpolated evidence, here the nearest voxel's
    assert not mine.label[mine.depth_m == 0].any() and not mine.confidence[mine.label == 0].any()
    close = np.abs(mine.rgb.astype(int) - theirs.rgb).max(axis=2) <= 16
    assert close[hit].mean() > 0.9


def test_a_view_from_where_the_camera_was_is_what_it_saw() -> None:
    pose = poses(14)[3]
    depth, label = seen(pose)
    view = ray_cast(whole(), pose, INTRINSICS)
    hit = (view.depth_m > 0) & (depth > 0)
    assert hit.sum() > 0.95 * (depth > 0).sum()
    assert np.median(np.abs(view.depth_m - depth)[hit]) < 0.003 and (view.label == label)[hit].mean() > 0.95


def test_single_rays_are_pixels_of_the_view() -> None:
    view = ray_cast(whole(), POSE, INTRINSICS)
    directions = ray_directions(INTRINSICS, POSE)[::7, ::7].reshape(-1, 3)
    hits = cast_rays(whole(), POSE[:3, 3], directions * 3.0)
    length = np.linalg.norm(directions, axis=1)
    depth = view.depth_m[::7, ::7].ravel()
    both = (depth > 0) & (hits.distance_m > 0)  # steps are of another length, so single grazing rays may differ
    assert (both == (depth > 0)).mean() > 0.99
    assert np.quantile(np.abs(hits.distance_m[both] - (depth * length)[both]), 0.99) < 1e-3
    assert (hits.label == view.label[::7, ::7].ravel())[both].mean() > 0.99


def test_a_ray_meets_the_ball_where_geometry_says() -> None:
    for turn in np.linspace(0, 2 * np.pi, 9):
        direction = -np.array([np.cos(turn), np.sin(turn), 1.0])
        hits = cast_rays(whole(), [BALL - 0.5 * direction], [direction])
        assert abs(hits.distance_m[0] - (0.5 * np.sqrt(2) - RADIUS)) < 0.006
        assert hits.label[0] == CUP and hits.confidence[0] > 0.5


def test_rays_that_go_too_short_or_nowhere_miss() -> None:
    above = BALL + np.array([0, 0, 0.6])
    assert cast_rays(whole(), above, (0, 0, -1), 0.38).distance_m[0] == 0
    assert cast_rays(whole(), above, (0, 0, -1), 0.42).distance_m[0] > 0.38
    up = cast_rays(whole(), above, (0, 0, 1))
    assert (up.distance_m[0], up.label[0], up.confidence[0]) == (0, 0, 0)
    assert len(cast_rays(whole(), np.empty((0, 3)), np.empty((0, 3))).label) == 0


@pytest.mark.parametrize("seed", range(3))
def test_hits_in_random_blocks_lie_on_a_zero_of_the_interpolated_field(seed: int) -> None:
    snapshot = random_map(seed)
    tsdf, observed, first = dense(snapshot)

    def field(p: np.ndarray) -> float:
        """TSDF at a point (voxel units), interpolated over the observed voxels."""
        low, total, fractions = np.floor(p).astype(int), 0.0, 0.0
        for corner in np.ndindex(2, 2, 2):
            at = low + corner
            if observed[tuple(at - first)]:
                fraction = float(np.prod(1 - np.abs(p - at)))
                total, fractions = total + fraction * tsdf[tuple(at - first)] / 127, fractions + fraction
        return total / fractions

    rng = np.random.default_rng(seed)
    origins, directions = rng.uniform(-0.3, 0.3, (300, 3)), rng.normal(size=(300, 3))
    directions[::10] = np.eye(3)[rng.integers(0, 3, 30)]  # along blocks and voxels
    origins[::20] = np.round(origins[::20] / 0.02) * 0.02
    hits = cast_rays(snapshot, origins, directions)
    met = np.flatnonzero(hits.distance_m)
    assert len(met) > 30
    places = origins + hits.distance_m[:, None] * directions / np.linalg.norm(directions, axis=1)[:, None]
    off = np.array([abs(field(places[n] / 0.02)) for n in met])
    assert np.median(off) < 2e-3 and np.quantile(off, 0.9) < 0.1  # a root may not be reached where noise is strong


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_corner_with_votes_speaks_for_a_point(seed: int) -> None:
    snapshot, rng = random_map(seed), np.random.default_rng(seed)
    _, observed, first = dense(snapshot)
    row_of = {tuple(key): row for row, key in enumerate(snapshot.keys.tolist())}
    points = rng.uniform(-18, 18, (300, 3))
    points[::3] = np.round(points[::3])
    slots, voxels = nearest_corners(points, snapshot)
    for p, slot, voxel in zip(points, slots, voxels, strict=True):
        candidates = []
        for corner in np.ndindex(2, 2, 2):
            at = np.floor(p).astype(int) + corner[::-1]
            if ((at < first) | (at >= first + observed.shape)).any() or not observed[tuple(at - first)]:
                continue
            x, y, z = at % 8
            mine = snapshot.slots[row_of[tuple((at // 8).tolist())]], 64 * z + 8 * y + x
            has_votes = snapshot.voxels.confidence[mine] > 0
            candidates.append((has_votes, float(np.prod(1 - np.abs(p - at))), mine))
        best = max((c[:2] for c in candidates), default=None)
        if best is None:
            assert slot == -1
        else:
            assert (slot, voxel) in [mine for *score, mine in candidates if tuple(score) == best]
