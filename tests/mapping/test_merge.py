"""Merging maps: sums where voxels coincide, interpolation where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import MapError, PoseError
from semantic_mapper.geometry import invert_pose, make_pose
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping import merge
from semantic_mapper.mapping.blocks import BlockValues, empty_blocks
from semantic_mapper.mapping.fusion import COMPUTED_CAP, MEASURED
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64
from tests.mapping.grids import corners, random_grid
from tests.mapping.rendered_views import LABELS, around, frame, small_map, sphere_depth, sure
from tests.mapping.test_voxel_map import CENTER, same

RADIUS = 0.4
UP = np.array((0.0, 0.0, 1.0))


def fuse_views(voxel_map: VoxelMap, views: range, T_map_world: Float64 | None = None) -> VoxelMap:
    """Some of twelve looks at a sphere, with votes that differ, into a map whose frame may not be the world's."""
    poses = around(CENTER, 1.2, 12)
    for n in views:
        depth = sphere_depth(poses[n], CENTER, RADIUS)
        pose = poses[n] if T_map_world is None else T_map_world @ poses[n]
        voxel_map.integrate(frame(pose, seq=n), depth, sure(n % 3, 0.6), depth > 0)
    return voxel_map


def turned(angles_deg: tuple[float, float, float], shift: tuple[float, float, float]) -> Float64:
    return make_pose(np.deg2rad(angles_deg), shift)


def measured_blocks(voxel_map: VoxelMap) -> dict:
    """Its state without the blocks that hold nothing, which a merged map leaves out."""
    state = voxel_map.block_state()
    holds = (state["weight"] > 0).any(axis=(1, 2, 3))
    return {name: values[holds] for name, values in state.items()}


@pytest.fixture(scope="module")
def halves() -> tuple[VoxelMap, VoxelMap]:
    return fuse_views(small_map(), range(5)), fuse_views(small_map(), range(5, 12))


def test_two_halves_make_the_map_of_the_whole(halves: tuple[VoxelMap, VoxelMap]) -> None:
    whole = measured_blocks(fuse_views(small_map(), range(12)))
    a, b = halves
    before = a.block_state(), b.block_state()
    joined = a.merged(b, np.eye(4))
    assert (joined.frames, joined.last_stamp_ns) == (12, 1011)
    state = joined.block_state()
    np.testing.assert_array_equal(state["keys"], whole["keys"])
    np.testing.assert_array_equal(state["weight"], whole["weight"])
    assert whole["weight"].max() > 4, "frames overlap"
    for name, tolerance in (("tsdf", 2e-6), ("color", 2e-4), ("votes", 2e-6), ("evidence", 3)):
        np.testing.assert_allclose(state[name].astype(float), whole[name], atol=tolerance, err_msg=name)
    assert same(before[0], a.block_state()) and same(before[1], b.block_state()), "merging changes neither"
    assert len(joined.changes(0).keys) == joined.block_count


def test_a_map_of_another_frame_comes_to_lie_where_it_belongs() -> None:
    T_a_b = turned((20, -35, 50), (0.31, -1.27, 0.553))
    a = fuse_views(small_map(), range(6))
    b = fuse_views(small_map(), range(6, 12), invert_pose(T_a_b))
    whole = fuse_views(small_map(), range(12))
    joined = a.merged(b, T_a_b)
    for voxel_map, worst, mean in ((whole, 0.012, 0.0022), (joined, 0.012, 0.0026)):
        points = voxel_map.points()
        error = np.abs(np.linalg.norm(points.xyz - CENTER, axis=1) - RADIUS)
        assert (np.quantile(error, 0.99) < worst) and error.mean() < mean
    points, expected = joined.points(), whole.points()
    assert abs(len(points.xyz) - len(expected.xyz)) < 0.1 * len(expected.xyz)
    view = around(CENTER, 1.25, 9)[4]
    mine, theirs = joined.ray_cast(view, frame().intrinsics), whole.ray_cast(view, frame().intrinsics)
    both = (mine.depth_m > 0) & (theirs.depth_m > 0)
    assert both.sum() > 0.97 * (theirs.depth_m > 0).sum()
    assert np.abs(mine.depth_m - theirs.depth_m)[both].mean() < 0.003
    assert (mine.label == theirs.label)[both].mean() > 0.85
    assert np.abs(mine.confidence - theirs.confidence)[both].mean() < 0.05


def test_maps_that_do_not_fit_are_refused(halves: tuple[VoxelMap, VoxelMap]) -> None:
    a, _ = halves
    with pytest.raises(MapError, match=r"voxel_size_m \(0.02 and 0.03\)"):
        a.merged(small_map(voxel_size_m=0.03), np.eye(4))
    with pytest.raises(MapError, match="differ in 9 cup, 9 mug"):
        a.merged(small_map(make_label_set("three", ("table", "mug", "wall"), ids=(5, 9, 2))), np.eye(4))
    with pytest.raises(MapError, match="order"):
        a.merged(small_map(make_label_set("three", ("cup", "table", "wall"), ids=(9, 5, 2))), np.eye(4))
    a.merged(small_map(make_label_set("other name", LABELS.names, ids=LABELS.ids)), np.eye(4))
    with pytest.raises(PoseError, match="merge"):
        a.merged(a, np.diag((1.0, 1.0, -1.0, 1.0)))
    with pytest.raises(MapError, match="max_blocks"):
        small_map(max_blocks=100).merged(a, np.eye(4))


def test_resampled_voxels_are_those_of_plain_numpy(rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng)
    T = turned((20.0, -35.0, 50.0), (0.6, -2.3, 1.9))
    R, t = np.ascontiguousarray(T[:3, :3].T), T[:3, 3].copy()
    keys = np.array([[0, 0, 0], [-1, 0, -1]], np.int32)
    moved = empty_blocks(2, 4)
    merge._resample_blocks(2, keys, R, t, index, buffers, moved)
    assert (moved.weight > 0).mean() > 0.3 and (moved.votes > 0).mean() > 0.2
    for n, voxel in np.ndindex(2, 512):
        p = R @ (keys[n] * 8 + np.array([voxel % 8, voxel // 8 % 8, voxel // 64]) - t)
        around = [(f, at) for f, at in corners(buffers, p) if f >= 1e-6]
        seen = [(f, at) for f, at in around if buffers.weight[at] > 0]
        total = 1.0
        values = [buffers.tsdf[at] for _, at in seen]
        if values and max(values) - min(values) > 0.95:  # a depth edge: the nearest voxel alone
            around = seen = [max(seen, key=lambda one: one[0])]
            total = seen[0][0]
        fraction = sum(f for f, _ in seen)
        if around and fraction >= 0.5 * total:
            mean = {
                name: sum(f * getattr(buffers, name)[at] for f, at in seen) / fraction
                for name in ("weight", "tsdf", "color")
            }
        else:
            mean = {"weight": 0.0, "tsdf": 0.0, "color": np.zeros(3)}
        for name, value in mean.items():
            np.testing.assert_allclose(getattr(moved, name)[n, voxel], value, rtol=1e-5, atol=1e-6)
        voted = [(f, at) for f, at in around if buffers.votes[at] > 0]
        fraction = sum(f for f, _ in voted)
        votes, said = 0.0, np.zeros(4)
        if voted and fraction >= 0.5 * total:
            votes = sum(f * buffers.votes[at] for f, at in voted) / fraction
            said = sum(f * buffers.votes[at] * buffers.evidence[at] for f, at in voted) / (votes * fraction)
        np.testing.assert_allclose(moved.votes[n, voxel], votes, rtol=1e-5)
        np.testing.assert_allclose(moved.evidence[n, voxel], said, atol=0.51)


def test_added_voxels_are_those_of_plain_numpy(rng: np.random.Generator) -> None:
    (_, buffers), (_, others) = random_grid(rng), random_grid(rng)
    before = type(buffers)(*(values.copy() for values in buffers))
    blocks, cap = np.array([5, 0, 8], np.int32), 6.0
    added = BlockValues(others.tsdf[:3], others.weight[:3], others.color[:3], others.evidence[:3], others.votes[:3])
    merge._add_block_values(3, blocks, buffers, added, cap)
    mine, theirs = before.weight[blocks].astype(float), added.weight.astype(float)
    new = theirs > 0
    weight = np.where(new, mine + theirs, 1.0)
    computed = (mine < MEASURED) & (theirs < MEASURED)  # two computed surfaces do not make a measured one
    assert (computed & new & (weight > COMPUTED_CAP)).any() and (~computed & (weight > cap)).any()
    most = np.minimum(weight, np.where(computed, COMPUTED_CAP, cap))
    np.testing.assert_allclose(buffers.weight[blocks], np.where(new, most, mine), rtol=1e-6)
    for name in ("tsdf", "color"):
        a, b, tail = getattr(before, name)[blocks], getattr(added, name), (..., None) if name == "color" else (...,)
        mean = np.where(new[tail], (mine[tail] * a + theirs[tail] * b) / weight[tail], a)
        np.testing.assert_allclose(getattr(buffers, name)[blocks], mean, rtol=1e-5, atol=1e-6)
    votes = before.votes[blocks].astype(float) + added.votes
    np.testing.assert_allclose(buffers.votes[blocks], np.minimum(votes, cap), rtol=1e-6)
    fraction = (added.votes / np.maximum(votes, 1e-9))[..., None]
    said = (1 - fraction) * before.evidence[blocks] + fraction * added.evidence
    np.testing.assert_allclose(buffers.evidence[blocks], said, atol=0.51)
    untouched = np.setdiff1d(np.arange(9), blocks)
    for now, then in zip(buffers, before, strict=True):
        assert now[untouched].tobytes() == then[untouched].tobytes()
