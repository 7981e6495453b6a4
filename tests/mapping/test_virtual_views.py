"""Virtual views look at what frames left without votes, from where a camera could stand, and change votes alone."""

from __future__ import annotations

import numpy as np

from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.mapping.blocks import unpack_keys
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.virtual_views import MARGIN_M, VOTE_WEIGHT, ViewpointChooser, add_votes, surface_patches
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float32, Float64
from tests.mapping.rendered_views import INTRINSICS, frame, plane_depth, small_map
from tests.mapping.test_keyframes import WALL, keyframe, pose
from tests.mapping.test_voxel_map import same
from tests.small import tiny_frames, tiny_pipeline

WALL_Z = 2.0
GEOMETRY = ("keys", "tsdf", "weight", "color")
KEYFRAMES = [keyframe(i, pose(x)) for i, x in enumerate((-0.2, 0.0, 0.2))]
SURE = np.array([0.9, 0.05, 0.05], np.float32)


def wall_map(columns: int) -> VoxelMap:
    """A wall seen from the origin, with votes in the leftmost ``columns`` of the 160 of the image."""
    made = small_map()
    known = np.zeros((INTRINSICS.height, INTRINSICS.width), np.bool_)
    known[:, :columns] = True
    view = frame(np.eye(4))
    made.integrate(view, wall_depth(np.eye(4)), np.broadcast_to(SURE, (*known.shape, 3)).copy(), known)
    return made


def wall_depth(T_world_camera: Float64, intrinsics: CameraIntrinsics = INTRINSICS) -> Float32:
    return plane_depth(T_world_camera, (0.0, 0.0, 1.0), WALL_Z, intrinsics)


def vote(voxel_map: VoxelMap, depth: Float32) -> int:
    rows = np.zeros(depth.shape, np.int32)
    return add_votes(voxel_map, np.eye(4), INTRINSICS, depth, (SURE[None], rows))


def geometry(voxel_map: VoxelMap) -> dict[str, bytes]:
    state = voxel_map.block_state()
    return {name: state[name].tobytes() for name in GEOMETRY}


def test_the_view_looks_at_the_part_without_votes_from_free_space():
    made = wall_map(80)
    view = ViewpointChooser(seed=0).choose(made, KEYFRAMES, INTRINSICS)
    assert view is not None
    eye, forward = view.T_world_camera[:3, 3], view.T_world_camera[:3, 2]
    target = eye + forward * (WALL_Z - eye[2]) / forward[2]
    assert target[0] > 0.1
    assert eye[2] < WALL_Z - MARGIN_M and np.linalg.norm(eye) < 1.5
    patches = surface_patches(made)
    assert (patches.need[np.isin(patches.packed, view.packed)] > 0).all()
    p = transform(invert_pose(view.T_world_camera), patches.xyz[np.isin(patches.packed, view.packed)])
    assert (np.abs(p[:, 0] / p[:, 2]) < 0.7).all(), "all of it is in the image"
    assert view.gain > 0.5 * 0.75 * patches.need[np.isin(patches.packed, view.packed)].sum()  # 3 keyframes of 4


def test_nothing_is_chosen_without_need_keyframes_or_a_clear_sight():
    def choose(columns: int, keyframes: list) -> object:
        return ViewpointChooser(seed=0).choose(wall_map(columns), keyframes, INTRINSICS)

    assert choose(160, KEYFRAMES) is None, "all has votes"
    assert choose(80, []) is None and choose(80, KEYFRAMES[:1]) is None
    hidden = [keyframe(i, pose(0.2 * i), depth=np.full_like(WALL, 1.0)) for i in range(3)]
    assert choose(80, hidden) is None, "something stands before the wall"
    assert choose(80, [keyframe(i, pose(0.2 * i, 180)) for i in range(3)]) is None, "they look the other way"


def test_what_was_looked_at_is_not_looked_at_again_until_the_map_is_replaced():
    made, chooser = wall_map(0), ViewpointChooser(seed=0)
    seen: list[int] = []
    while (view := chooser.choose(made, KEYFRAMES, INTRINSICS)) is not None:
        assert not np.isin(view.packed, seen).any()
        seen.extend(view.packed)
    assert (unpack_keys(np.array(seen))[:, 2] == np.floor(WALL_Z / 0.16)).mean() > 0.4
    made.take_over(wall_map(0))
    assert chooser.choose(made, KEYFRAMES, INTRINSICS) is not None


def test_a_vote_weighs_its_share_of_that_of_a_frame_and_nothing_else_changes():
    silent, voted, depth = wall_map(0), wall_map(160), wall_depth(np.eye(4))
    before, frames, version = geometry(silent), silent.frames, silent.version
    touched = vote(silent, depth)
    assert geometry(silent) == before and silent.frames == frames
    assert silent.version == version + 1 and len(silent.changes(version).keys) == touched > 0
    ours, frames_votes = silent.block_state(), voted.block_state()
    assert frames_votes["votes"].max() > 0.9
    np.testing.assert_allclose(ours["votes"], VOTE_WEIGHT * frames_votes["votes"], rtol=1e-5)
    np.testing.assert_allclose(ours["evidence"], frames_votes["evidence"], atol=1)


def test_no_block_is_made_where_the_map_has_none():
    made = wall_map(0)
    before = made.block_state()
    assert vote(made, np.full((INTRINSICS.height, INTRINSICS.width), 1.0, np.float32)) == 0
    assert same(made.block_state(), before) and made.version == 1


def make_pipeline(**changes: object) -> MappingPipeline:
    return tiny_pipeline(**{"keyframes": {"translation_m": 0.02}, **changes})


def half_mapped(**changes: object) -> MappingPipeline:
    """Every second frame is fused without classes."""
    pipeline = make_pipeline(**changes)
    for number, f in enumerate(tiny_frames(12)):
        if number % 4:
            assert f.depth_m is not None
            pipeline.voxel_map.integrate(f, f.depth_m, None)
        else:
            pipeline.step(f)
    return pipeline


def test_looking_around_gives_votes_to_surface_without_any_and_repeats_to_the_bit():
    a, b = half_mapped(), half_mapped()
    before, state = geometry(a.voxel_map), a.voxel_map.block_state()
    looks = [a.render_virtual_view() for _ in range(3)]
    assert all(look is not None and len(look.packed) for look in looks[:1])
    assert geometry(a.voxel_map) == before and a.voxel_map.frames == 12
    votes = a.voxel_map.block_state()["votes"]
    assert ((votes > 0) & (state["votes"] == 0)).sum() > 100
    for _ in range(3):
        b.render_virtual_view()
    assert same(a.voxel_map.block_state(), b.voxel_map.block_state())


def test_steps_render_virtual_views_only_where_they_are_told_to():
    frames = tiny_frames(6)
    off, on = make_pipeline(), make_pipeline(virtual={"every_n_frames": 3})
    assert all("virtual" not in off.step(f).stage_ms for f in frames)
    assert ["virtual" in on.step(f).stage_ms for f in frames] == [False, False, True] * 2
    assert geometry(off.voxel_map) == geometry(on.voxel_map)


def test_a_correction_rebuilds_the_map_without_virtual_votes():
    pipeline = half_mapped(history={"max_frames": 100})
    silent = make_pipeline()
    stepped = tiny_frames(12)[::4]
    for f in stepped:
        silent.step(f)
    assert pipeline.render_virtual_view()
    pipeline.corrector.start({stepped[0].stamp_ns: stepped[0].T_world_camera})
    while pipeline.corrector.advance(3):
        pass
    assert same(pipeline.voxel_map.block_state(), silent.voxel_map.block_state())
