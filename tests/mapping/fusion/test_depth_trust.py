"""Rendered depth weighs less than measured depth, and nothing where it is uncertain."""

from __future__ import annotations

import numpy as np

from semantic_mapper.mapping.frame_depth import GUESS_TRUST, MOST_TRUST, rendered_trust
from semantic_mapper.mapping.fusion.fuse import (
    COMPUTED_CAP,
    COMPUTED_LOOK,
    MEASURED,
    SURFACE_WEIGHT,
)
from tests.mapping.rendered_views import frame, plane_depth, small_map

TRUNCATION_M = 0.08
POSE = np.eye(4)


def slanted() -> np.ndarray:
    return plane_depth(POSE, (0.2, 0.1, 1.0), 2.0)


def test_a_smooth_surface_where_the_map_has_one_is_trusted_most_and_beyond_it_little() -> None:
    depth = slanted()
    known = depth.copy()
    known[:, :80] = 0
    trust = rendered_trust(depth, known, TRUNCATION_M)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(trust[inner][:, 90:], MOST_TRUST, rtol=0.02)
    np.testing.assert_allclose(trust[inner][:, :70], GUESS_TRUST, rtol=0.02)


def test_any_number_of_computed_looks_weighs_less_than_one_measurement() -> None:
    depth = slanted()
    voxel_map = small_map()
    for seq in range(40):
        voxel_map.integrate(frame(seq=seq), depth, None, trust=np.full_like(depth, MOST_TRUST), measured=False)
        if seq < 2:
            assert voxel_map.block_state()["weight"].max() == (seq + 1) * COMPUTED_LOOK
            assert bool(len(voxel_map.points().xyz)) == ((seq + 1) * COMPUTED_LOOK >= SURFACE_WEIGHT)
    assert voxel_map.block_state()["weight"].max() == COMPUTED_CAP < MEASURED
    assert not voxel_map.points().measured.any()


def test_one_measurement_outweighs_all_that_was_computed_and_is_then_left_alone() -> None:
    near, far = plane_depth(POSE, (0.0, 0.0, 1.0), 1.0), plane_depth(POSE, (0.0, 0.0, 1.0), 1.04)
    voxel_map = small_map()
    for seq in range(40):
        voxel_map.integrate(frame(seq=seq), near, None, measured=False)
    voxel_map.integrate(frame(seq=40), far, None)
    points = voxel_map.points()
    assert points.measured.mean() > 0.9 and np.median(points.xyz[:, 2]) > 1.02
    before = voxel_map.block_state()
    voxel_map.integrate(frame(seq=41, rgb=200), near, None, measured=False)
    after = voxel_map.block_state()
    old = before["weight"] >= MEASURED
    assert old.any()
    for name in ("tsdf", "weight", "color"):
        assert before[name][old].tobytes() == after[name][old].tobytes(), name


def test_depth_edges_and_pixels_beside_unknown_ones_are_not_fused() -> None:
    depth = slanted()
    depth[:, 100:] += 0.3
    depth[50, 40] = 0
    trust = rendered_trust(depth, depth, TRUNCATION_M)
    assert (trust[:, 99:101] == 0).all() and (trust[49:52, 40] == 0).all() and (trust[50, 39:42] == 0).all()
    assert (trust[10:40, 20:90] > 0.4).all()
