"""Rendered depth weighs less than measured depth, and nothing where it is uncertain."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import ShapeError
from semantic_mapper.mapping.fusion.depth_trust import (
    COMPUTED_CAP,
    COMPUTED_LOOK,
    GUESS_TRUST,
    MEASURED,
    MOST_TRUST,
    SURFACE_WEIGHT,
    depth_trust,
)
from tests.mapping.rendered_views import INTRINSICS, frame, plane_depth, small_map, sure

TRUNCATION_M = 0.08
POSE = np.eye(4)


def slanted() -> np.ndarray:
    return plane_depth(POSE, (0.2, 0.1, 1.0), 2.0)


def test_a_smooth_surface_where_the_map_has_one_is_trusted_most_and_beyond_it_little() -> None:
    depth = slanted()
    known = depth.copy()
    known[:, :80] = 0
    trust = depth_trust(depth, known, TRUNCATION_M)
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


def test_trust_falls_with_distance_from_the_map_to_nothing() -> None:
    depth = slanted()
    means = [depth_trust(depth, depth + np.float32(off), TRUNCATION_M)[40:80, 40:120].mean() for off in (0, 0.04, 0.2)]
    assert means[0] > 2 * means[1] > 0 == means[2]


def test_depth_edges_and_pixels_beside_unknown_ones_are_not_fused() -> None:
    depth = slanted()
    depth[:, 100:] += 0.3
    depth[50, 40] = 0
    trust = depth_trust(depth, depth, TRUNCATION_M)
    assert (trust[:, 99:101] == 0).all() and (trust[49:52, 40] == 0).all() and (trust[50, 39:42] == 0).all()
    assert (trust[10:40, 20:90] > 0.4).all()


def test_a_trusted_share_moves_the_surface_by_its_share_and_counts_as_much() -> None:
    near, far = plane_depth(POSE, (0.0, 0.0, 1.0), 1.0), plane_depth(POSE, (0.0, 0.0, 1.0), 1.04)
    voxel_map = small_map()
    voxel_map.integrate(frame(), near, sure(0), None)
    voxel_map.integrate(frame(), far, sure(1), None, trust=np.full_like(far, 0.25))
    z = voxel_map.points().xyz[:, 2]
    assert np.median(z) == pytest.approx(1.0 + 0.04 * 0.25 / 1.25, abs=0.001)
    state = voxel_map.block_state()
    assert set(np.unique(state["weight"])) <= {0.0, 0.25, 1.0, 1.25}
    both = state["weight"] == 1.25
    assert 0 < state["votes"][both].max() <= 1.25


def test_no_trust_is_no_measurement_and_full_trust_is_one() -> None:
    depth = slanted()
    plain, trusted, without = small_map(), small_map(), small_map()
    plain.integrate(frame(), depth, sure(0), None)
    trusted.integrate(frame(), depth, sure(0), None, trust=np.ones_like(depth))
    assert without.integrate(frame(), depth, sure(0), None, trust=np.zeros_like(depth)) == 0
    for name, values in plain.block_state().items():
        assert values.tobytes() == trusted.block_state()[name].tobytes(), name
    for bad in (np.full_like(depth, 1.5), np.full_like(depth, np.nan), np.ones((2, 2), np.float32)):
        with pytest.raises(ShapeError, match="trust"):
            plain.integrate(frame(), depth, sure(0), None, trust=bad)
    assert plain.frames == 1 and INTRINSICS.width == depth.shape[1]
