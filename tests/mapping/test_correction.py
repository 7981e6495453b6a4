"""The map after a correction is the map that the corrected poses make."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.errors import MapError, PoseError
from semantic_mapper.fields.checkpoint import streaming
from semantic_mapper.geometry import make_pose
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.correction import ALWAYS, PoseCorrection, PosePair
from semantic_mapper.mapping.odometry_sessions import OdometrySessions
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64, PosedFrame
from tests.mapping.test_segmenter import painted, write_model
from tests.small import tiny_field, tiny_frames, tiny_pipeline


def make_pipeline(max_frames: int = 100, **changes: object) -> MappingPipeline:
    base = {
        "render": {"encode_width": 96, "scale": 0.25},
        "keyframes": {"source_views": 2, "translation_m": 0.1},
        "history": {"max_frames": max_frames},
    }
    return tiny_pipeline(**{**base, **changes})


def mapped(frames: list[PosedFrame] | tuple[PosedFrame, ...], **changes: object) -> MappingPipeline:
    pipeline = make_pipeline(**changes)  # type: ignore[arg-type]
    for frame in frames:
        pipeline.step(frame)
    return pipeline


def finish(pipeline: MappingPipeline) -> None:
    while pipeline.corrector.advance(3):
        pass


def drift(fraction: float) -> Float64:
    """(4, 4) in the world: up to 9 cm and 4.5 degrees away from the truth."""
    turn = np.radians([1.0, -1.5 * np.cos(2 * fraction), 4.0]) * fraction
    return make_pose(turn, (0.06 * np.sin(2.5 * fraction), -0.05 * fraction, 0.04 * fraction**2))


def drifted(frames: tuple[PosedFrame, ...]) -> list[PosedFrame]:
    last = len(frames) - 1
    return [replace(f, T_world_camera=drift(i / last) @ f.T_world_camera) for i, f in enumerate(frames)]


def true_poses(frames: tuple[PosedFrame, ...], stride: int) -> dict[int, Float64]:
    chosen = {*range(0, len(frames), stride), len(frames) - 1}
    return {frames[i].stamp_ns: frames[i].T_world_camera for i in sorted(chosen)}


def same(a: VoxelMap, b: VoxelMap) -> bool:
    x, y = a.block_state(), b.block_state()
    return a.frames == b.frames and all(x[k].tobytes() == y[k].tobytes() for k in x)


@pytest.mark.parametrize("max_frames", [100, 3])
def test_unchanged_poses_give_the_same_map_to_the_bit_also_where_frames_have_left(max_frames: int):
    frames = list(tiny_frames())
    frames[3] = replace(frames[3], depth_m=None)
    pipeline = mapped(frames, max_frames=max_frames)
    without = mapped(frames, max_frames=0)
    assert same(pipeline.voxel_map, without.voxel_map)
    pipeline.corrector.start(
        {frames[-1].stamp_ns: frames[-1].T_world_camera, frames[3].stamp_ns: frames[3].T_world_camera}
    )
    finish(pipeline)
    assert pipeline.corrector.status.completed == 1
    assert same(pipeline.voxel_map, without.voxel_map)


def test_frames_move_with_given_poses_of_their_own_world_alone():
    frames = [replace(f, world=int(i > 2)) for i, f in enumerate(tiny_frames(6))]
    pipeline = mapped(frames)
    pipeline.corrector.start({frames[4].stamp_ns: drift(0.5) @ frames[4].T_world_camera}, until_ns=ALWAYS)
    finish(pipeline)
    poses = pipeline.corrector.poses()
    for frame in frames:
        moved = drift(0.5) if frame.world else np.eye(4)
        placed = poses[frame.camera_id, frame.stamp_ns]
        np.testing.assert_allclose(placed, moved @ frame.T_world_camera, atol=1e-9)
    assert np.array_equal(pipeline.corrector.motion(0), np.eye(4))
    np.testing.assert_allclose(pipeline.corrector.motion(1), drift(0.5), atol=1e-9)


def test_frames_that_come_during_the_rebuild_are_in_the_new_map():
    frames = tiny_frames(8)
    at_once, between = mapped(drifted(frames)[:5]), mapped(drifted(frames)[:5])
    poses = true_poses(frames[:5], 2)
    between.corrector.start(poses)
    old = between.voxel_map.block_state()
    assert between.corrector.advance(2) and old["tsdf"].tobytes() == between.voxel_map.block_state()["tsdf"].tobytes()
    for frame in drifted(frames)[5:]:
        between.step(frame)
        assert between.corrector.advance(1)
    finish(between)
    for frame in drifted(frames)[5:]:
        at_once.step(frame)
    at_once.corrector.start(poses)
    finish(at_once)
    assert between.voxel_map.frames == 8 and same(between.voxel_map, at_once.voxel_map)


def test_a_correction_during_another_one_is_as_if_it_came_after_it():
    frames = tiny_frames()
    late = drifted(frames)
    first = {
        late[0].stamp_ns: drift(0.3) @ late[0].T_world_camera,
        late[4].stamp_ns: drift(0.1) @ late[4].T_world_camera,
    }
    second = {late[1].stamp_ns: frames[1].T_world_camera, late[5].stamp_ns: frames[5].T_world_camera}
    joined, in_a_row = mapped(late), mapped(late)
    joined.corrector.start(first, until_ns=ALWAYS)
    joined.corrector.advance(4)
    assert joined.corrector.start(second).done == 0
    finish(joined)
    for poses, until_ns in ((first, ALWAYS), (second, None)):
        in_a_row.corrector.start(poses, until_ns=until_ns)
        finish(in_a_row)
    assert same(joined.voxel_map, in_a_row.voxel_map)
    assert joined.corrector.status == in_a_row.corrector.status
    assert (
        joined.corrector.place(late[0]).T_world_camera.tobytes()
        == in_a_row.corrector.place(late[0]).T_world_camera.tobytes()
    )


def test_keyframes_move_with_their_frames_and_anchors_of_another_recording_stay():
    frames = tiny_frames()
    late = drifted(frames)
    config = make_pipeline().config
    foreign = replace(tiny_frames(2, 8)[1], stamp_ns=5)
    anchors = (foreign, replace(late[2], T_world_camera=late[2].T_world_camera.copy()))
    pipeline = MappingPipeline(config, streaming(tiny_field(), config.sampling), ROOMS, anchors=anchors)
    for frame in late:
        pipeline.step(frame)
    before = pipeline.keyframes.keyframes
    assert [k.labelled for k in before[:3]] == [True, True, False]
    pipeline.corrector.start(true_poses(frames, 1))
    finish(pipeline)
    after = pipeline.keyframes.keyframes
    assert after[0] is before[0]
    true = {f.stamp_ns: f.T_world_camera for f in frames}
    for old, new in zip(before[1:], after[1:], strict=True):
        assert new.T_world_camera.tobytes() == true[old.stamp_ns].tobytes()
        assert new.encoded.feature is old.encoded.feature and new.depth_m is old.depth_m
        expected = np.linalg.inv(true[old.stamp_ns])[:3]
        np.testing.assert_allclose(new.encoded.T_camera_world[0], expected, atol=1e-6)


def test_a_correction_leaves_nothing_that_is_known_by_old_poses(tmp_path: Path):
    frames = [replace(f, depth_m=np.full_like(f.rgb[..., 0], 2, np.float32)) for f in map(painted, tiny_frames(2))]
    aside = make_pose((0, 0, 0), (0.5, 0, 0))
    moved = [replace(f, T_world_camera=frames[0].T_world_camera @ aside) for f in frames]
    segmenter, moving = {"table": str(write_model(tmp_path))}, {"motion": False, "classes": True}
    pipeline = make_pipeline(segmenter=segmenter, moving=moving)
    (first,) = OdometrySessions(pipeline).take(frames[0]).ready
    shown = pipeline.step(first).moving
    pipeline.corrector.start({first.stamp_ns: moved[0].T_world_camera})
    finish(pipeline)
    assert pipeline.last_pose is not None and pipeline.last_pose.T_map_camera is not None
    np.testing.assert_allclose(pipeline.last_pose.T_map_camera, moved[0].T_world_camera)
    assert shown is not None and shown.any()
    assert np.array_equal(pipeline.step(moved[1]).moving, shown)  # of this picture, not where the last one was


def test_poses_that_contradicted_each_other_are_judged_where_a_correction_has_moved_them():
    frames = tiny_frames(24)
    wrong = [replace(f, T_world_camera=np.linalg.inv(f.T_world_camera)) for f in frames]
    pipeline = mapped(wrong)
    assert "poses inverted" in pipeline.pose_check.warning
    compared = pipeline.pose_check.compared
    pipeline.corrector.start({f.stamp_ns: f.T_world_camera for f in wrong})  # no better than they are
    finish(pipeline)
    assert "poses inverted" in pipeline.pose_check.warning and pipeline.pose_check.compared >= 0.8 * compared
    pipeline.corrector.start(true_poses(frames, 1))
    finish(pipeline)
    worst = pipeline.pose_check.worst
    assert not pipeline.pose_check.warning and worst is not None and worst < 0.01


def test_later_frames_are_trusted_unless_their_odometry_goes_on_in_the_old_world():
    frames = tiny_frames()
    late = drifted(frames)
    motion = drift(1.0)
    trusting, moving = mapped(late[:4]), mapped(late[:4])
    poses = {f.stamp_ns: motion @ f.T_world_camera for f in late[1:3]}
    trusting.corrector.start(poses)
    moving.corrector.start(poses, until_ns=ALWAYS)
    for pipeline in (trusting, moving):
        pipeline.step(late[4])  # comes during the rebuild
        finish(pipeline)
        pipeline.step(late[5])
    for pipeline, expected in ((trusting, np.eye(4)), (moving, motion)):
        at = pipeline.corrector.poses()
        for frame in late[3:]:
            np.testing.assert_allclose(at["rooms", frame.stamp_ns], expected @ frame.T_world_camera, atol=1e-12)
        for frame in late[:3]:
            np.testing.assert_allclose(at["rooms", frame.stamp_ns], motion @ frame.T_world_camera, atol=1e-12)


def test_queries_and_steps_go_on_during_a_rebuild_in_another_thread():
    frames = tiny_frames()
    late = drifted(frames)
    pipeline = mapped(late)
    view = frames[2]
    seen: set[tuple[bytes, bytes]] = set()

    def look() -> tuple[bytes, bytes]:
        cast = pipeline.voxel_map.ray_cast(view.T_world_camera, view.intrinsics)
        return pipeline.voxel_map.points().xyz.tobytes(), cast.depth_m.tobytes()

    old = look()
    pipeline.corrector.start(true_poses(frames, 1))
    rebuild = threading.Thread(target=finish, args=(pipeline,))
    rebuild.start()
    while rebuild.is_alive():
        seen.add(look())
    rebuild.join()
    new = look()
    points, casts = {old[0], new[0]}, {old[1], new[1]}
    assert len(points) == 2 and {p for p, _ in seen} <= points and {c for _, c in seen} <= casts


def test_a_pose_out_of_reach_of_any_voxel_is_given_up_and_mapping_goes_on():
    frames = tiny_frames(8)
    pipeline = mapped(frames[:6], max_frames=20, voxel_map={"voxel_size_m": 0.01})
    before = mapped(frames[:6], max_frames=0, voxel_map={"voxel_size_m": 0.01}).voxel_map
    far = frames[3].T_world_camera.copy()
    far[0, 3] = 1e7
    with pytest.raises(PoseError, match="nearer origin"):
        pipeline.corrector.start({frames[3].stamp_ns: far})
    far[0, 3] = 9e4  # keys of 1 cm voxels reach 84 km
    assert pipeline.corrector.start({frames[3].stamp_ns: far}).running
    with pytest.raises(MapError, match="given up, the map stays as it is"):
        finish(pipeline)
    status = pipeline.corrector.status
    assert not status.running and "beyond" in status.failure and same(pipeline.voxel_map, before)
    assert pipeline.step(frames[6]).fused
    pipeline.corrector.start({frames[3].stamp_ns: drift(0.5) @ frames[3].T_world_camera})
    finish(pipeline)
    assert pipeline.corrector.status.completed == 1 and pipeline.corrector.status.failure == ""


def test_a_damaged_frame_is_left_out_counted_and_logged():
    frames = tiny_frames()
    pipeline = mapped(drifted(frames))
    pipeline.corrector._scratch._database.execute("UPDATE blobs SET blob = x'00' WHERE key = 2")
    pipeline.corrector.start(true_poses(frames, 1))
    with structlog.testing.capture_logs() as logs:
        finish(pipeline)
    assert [e["seq"] for e in logs if e["event"] == "history_frame_lost"] == [2]
    assert pipeline.corrector.status.lost == 1 and pipeline.voxel_map.frames == 5
    by_hand = VoxelMap(pipeline.config.voxel_map, ROOMS)
    for frame in (*frames[:2], *frames[3:]):
        by_hand.integrate(frame, frame.depth_m, None, None)
    assert pipeline.voxel_map.block_state()["tsdf"].tobytes() == by_hand.block_state()["tsdf"].tobytes()


def test_a_disk_that_fails_ends_correcting_but_not_mapping():
    frames = tiny_frames()
    pipeline = mapped(frames[:3])
    pipeline.corrector.start({frames[1].stamp_ns: frames[1].T_world_camera})
    pipeline.corrector._scratch._database.execute("DROP TABLE blobs")
    with structlog.testing.capture_logs() as logs:
        for frame in frames[3:]:
            assert pipeline.step(frame).fused
    assert [e["event"] for e in logs if e["log_level"] == "error"] == ["history_ends"]
    assert "history has ended: frame seq=3" in pipeline.corrector.status.failure
    with pytest.raises(MapError, match="history has ended"):
        pipeline.corrector.start({frames[1].stamp_ns: frames[1].T_world_camera})
    assert not pipeline.corrector.status.running and same(pipeline.voxel_map, mapped(frames, max_frames=0).voxel_map)


def test_poses_that_cannot_be_used_are_refused_and_change_nothing():
    frames = tiny_frames()
    pipeline = mapped(frames)
    pipeline.step(replace(frames[5], camera_id="rear"))
    pose = frames[1].T_world_camera
    bad = pose.copy()
    bad[1, 3] = np.nan
    refused = [
        ({}, MapError, "none was given"),
        ({frames[1].stamp_ns: bad}, PoseError, f"corrected pose of stamp {frames[1].stamp_ns}.*NaN"),
        ({frames[1].stamp_ns + 2_000_000: pose}, MapError, rf"no frame.*nearest is {frames[1].stamp_ns}"),
        ({("side", frames[1].stamp_ns): pose}, MapError, "of camera 'side': no frame"),
        ({frames[5].stamp_ns: pose}, MapError, r"cameras rear, rooms have this stamp; give \(camera_id, stamp_ns\)"),
    ]
    for poses, error, message in refused:
        with pytest.raises(error, match=message):
            pipeline.corrector.start(poses)
        assert not pipeline.corrector.status.running
    pipeline.corrector.start({("rear", frames[5].stamp_ns): frames[5].T_world_camera})
    with pytest.raises(MapError, match=r"no frames are kept; set history\.max_frames"):
        make_pipeline(max_frames=0).corrector.start({1: pose})
    assert not make_pipeline().corrector.advance()


def test_the_history_is_bounded_and_frames_that_have_left_it_stay_where_they_are() -> None:
    frames = tiny_frames(17)
    late = drifted(frames)
    pipeline = mapped(late[:9], max_frames=4, moving={"motion": False})
    status = pipeline.corrector.status
    assert (status.total, status.frozen) == (5, 4) and status.disk_bytes > 10_000
    with structlog.testing.capture_logs() as logs:
        pipeline.corrector.start(true_poses(frames[:9], 1))
    partial = [e for e in logs if e["event"] == "correction_is_partial"]
    assert len(partial) == 1 and (partial[0]["given"], partial[0]["frozen"]) == (9, 4)
    finish(pipeline)
    with pytest.raises(MapError, match="all 1 frames given have left the history"):
        pipeline.corrector.start({frames[0].stamp_ns: frames[0].T_world_camera})
    with pytest.raises(MapError, match="no frame with this stamp was mapped"):
        pipeline.corrector.start({frames[8].stamp_ns + 1: frames[0].T_world_camera})
    for frame in late[9:]:
        pipeline.step(frame)
    assert pipeline.corrector.status.frozen == 12
    pipeline.corrector.start(true_poses(frames[12:], 1))
    finish(pipeline)
    by_hand = VoxelMap(pipeline.config.voxel_map, ROOMS)
    for frame in (*late[:4], *frames[4:9], *late[9:12], *frames[12:]):
        by_hand.integrate(frame, frame.depth_m, None, None)
    ours, expected = pipeline.voxel_map.block_state(), by_hand.block_state()
    for name in ("keys", "tsdf", "weight", "color"):
        assert ours[name].tobytes() == expected[name].tobytes(), name


def test_steps_continue_a_rebuild_where_the_history_is_full_and_nobody_else_does() -> None:
    frames = tiny_frames(14)
    pipeline = mapped(frames[:8], max_frames=3)
    pipeline.corrector.start({frames[7].stamp_ns: drift(0.5) @ frames[7].T_world_camera})
    for frame in frames[8:]:
        pipeline.step(frame)
        assert pipeline.corrector.status.total <= 7
    status = pipeline.corrector.status
    assert status.completed == 1 and not status.running
    assert status.total + status.frozen == pipeline.voxel_map.frames == 14 and status.frozen >= 8


def test_the_bytes_on_disk_are_bounded() -> None:
    frames = [replace(f, seq=n, stamp_ns=n + 1) for n, f in enumerate(tiny_frames(12) * 4)]
    pipeline = make_pipeline(history={"max_frames": 1000, "max_disk_mb": 1})
    for frame in frames:
        pipeline.step(frame)
        assert pipeline.corrector.status.disk_bytes < 1_100_000
    assert pipeline.corrector.status.frozen > 3


small = st.floats(-0.5, 0.5)
vectors = st.tuples(small, small, small).map(np.array)


def test_halfway_in_time_a_frame_turns_by_half_the_angle_and_goes_half_the_way() -> None:
    axis = np.array([0.0, 0.0, 1.0])
    here = make_pose(np.zeros(3), np.array([2.0, 0.0, 0.0]))
    turned = here @ make_pose(0.4 * axis, np.array([0.0, 0.1, 0.0]))
    correction = PoseCorrection([PosePair("a", 0, here, here.copy()), PosePair("a", 200, here, turned)], 200)
    placed = correction.place("a", 50, here)
    np.testing.assert_allclose(placed[:3, :3], make_pose(0.1 * axis, np.zeros(3))[:3, :3], atol=1e-12)
    np.testing.assert_allclose(placed[:3, 3], [2.0, 0.025, 0.0], atol=1e-12)
    np.testing.assert_allclose(correction.place("rear", 200, here), turned, atol=1e-12)  # on the same body
    assert correction.place("a", 201, here) is here
    assert PoseCorrection([PosePair("a", 0, here, turned)], ALWAYS).place("a", 0, here) is turned


@given(vectors, vectors, vectors, vectors, st.floats(0.01, 0.99))
def test_where_the_world_has_its_origin_makes_no_difference(turn_a, shift_a, turn_b, shift_b, fraction) -> None:
    """Blended translations would fail this: the far origin is a lever."""
    motions = make_pose(turn_a, shift_a), make_pose(turn_b, shift_b)
    poses = [make_pose(np.array([0.1 * i, 0.2, -0.1 * i]), np.array([0.3 * i, 0.1, 1.0])) for i in range(3)]
    far = make_pose(np.array([0.3, -1.0, 0.5]), np.array([300.0, -200.0, 50.0]))

    def placed(G: Float64) -> Float64:
        pairs = [PosePair("a", n * 10**9, G @ poses[n], G @ m @ poses[n]) for n, m in enumerate(motions)]
        return PoseCorrection(pairs, 10**9).place("a", int(fraction * 10**9), G @ poses[2])

    np.testing.assert_allclose(placed(far), far @ placed(np.eye(4)), atol=1e-9)
