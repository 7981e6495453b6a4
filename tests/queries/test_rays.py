"""Rays through a snapshot against the map's own ray cast and against geometry."""

from __future__ import annotations

import numpy as np

from semantic_mapper.geometry import look_at
from semantic_mapper.queries.rays import cast_rays, ray_cast
from tests.mapping.views import INTRINSICS, ray_directions
from tests.queries.scene import BALL, CUP, MIDDLE, RADIUS, poses, seen, whole, whole_map

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
