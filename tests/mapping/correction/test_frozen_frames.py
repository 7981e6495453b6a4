"""The history keeps what it promises; frames that have left it stay in the map where they are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import structlog

from semantic_mapper.errors import MapError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.correction.test_corrected_map import drift, drifted, finish, make_pipeline, mapped, true_poses
from tests.small import tiny_frames


def test_the_history_is_bounded_and_steps_carry_on_a_rebuild_that_nobody_else_does():
    frames = tiny_frames(14)
    pipeline = mapped(frames[:8], max_frames=6)
    assert pipeline.corrector.status.total == 7 and pipeline.corrector.status.frozen == 1
    pipeline.correct_poses({frames[7].stamp_ns: drift(0.5) @ frames[7].T_world_camera})
    longest = 0
    for frame in frames[8:]:
        pipeline.step(frame)
        longest = max(longest, pipeline.corrector.status.total)
    status = pipeline.corrector.status
    assert status.completed == 1 and not status.running
    assert status.disk_bytes > sum(e.bytes for e in pipeline.corrector._history.entries()) > 10_000
    assert 7 < longest <= 10 and status.total == 7 and status.total + status.frozen == pipeline.voxel_map.frames == 14


def test_the_disk_that_frames_and_journal_take_together_is_bounded():
    frames = [replace(f, seq=n, stamp_ns=n + 1) for n, f in enumerate(tiny_frames(12) * 4)]
    free, bounded = make_pipeline(max_frames=1000), make_pipeline(history={"max_frames": 1000, "max_disk_mb": 4})
    most = 0
    for frame in frames:
        free.step(frame)
        bounded.step(frame)
        most = max(most, bounded.corrector.status.disk_bytes)
    frames_alone = sum(e.bytes for e in free.corrector._history.entries())
    status = bounded.corrector.status
    assert frames_alone < 4_000_000, "it is the journal that makes them leave"
    assert most < 4_000_000 * 1.3 and status.frozen > 10 and status.total >= 3
    assert status.frozen + status.total == len(frames)


@pytest.mark.parametrize(("max_frames", "at_most"), [(1, 2), (8, 9), (9, 11), (20, 23)])
def test_the_last_max_frames_can_always_be_corrected_and_few_more(max_frames: int, at_most: int):
    frame, kept = tiny_frames(1)[0], []
    pipeline = make_pipeline(max_frames=max_frames)
    for n in range(40):
        pipeline.step(replace(frame, seq=n, stamp_ns=n + 1))
        stamps = [stamp_ns for _, stamp_ns in pipeline.corrector.poses()]
        assert stamps == list(range(n + 2 - len(stamps), n + 2))
        assert len(stamps) >= min(n + 1, max_frames)
        kept.append(len(stamps))
    assert max(kept) == at_most and min(kept[at_most:]) > max_frames
    pipeline.correct_poses({stamps[0]: frame.T_world_camera})


def test_frozen_frames_stay_where_they_are_and_a_correction_of_them_is_told_to_be_partial():
    frames = tiny_frames(13)
    late = drifted(frames)
    pipeline = mapped(late[:7], max_frames=4, moving={"motion": False})  # decides by poses, too
    with structlog.testing.capture_logs() as logs:
        pipeline.correct_poses(true_poses(frames[:7], 1))
    partial = [e for e in logs if e["event"] == "correction_is_partial"]
    assert len(partial) == 1 and (partial[0]["given"], partial[0]["frozen"]) == (7, 2)
    finish(pipeline)
    with pytest.raises(MapError, match="all 1 frames given have left the history"):
        pipeline.correct_poses({frames[0].stamp_ns: frames[0].T_world_camera})
    for frame in late[7:]:  # freezes frames 2 to 7, all but the last where the correction has put them
        pipeline.step(frame)
    assert [stamp for _, stamp in pipeline.corrector.poses()] == [f.stamp_ns for f in frames[8:]]
    pipeline.correct_poses(true_poses(frames[8:], 1))
    finish(pipeline)
    by_hand = VoxelMap(pipeline.config.voxel_map, ROOMS)
    for frame in (*late[:2], *frames[2:7], late[7], *frames[8:]):
        by_hand.integrate(frame, frame.depth_m, None, None)
    ours, expected = pipeline.voxel_map.block_state(), by_hand.block_state()
    for name in ("keys", "tsdf", "weight", "color"):
        assert ours[name].tobytes() == expected[name].tobytes(), name


def test_a_stamp_that_never_was_is_told_from_one_that_has_left():
    frames = list(tiny_frames(8))
    frames[1] = replace(frames[1], camera_id="rear")
    pipeline = mapped(frames, max_frames=3)
    assert pipeline.corrector.status.frozen == 4
    pose = frames[0].T_world_camera
    for left in (frames[0].stamp_ns, frames[1].stamp_ns, ("rear", frames[1].stamp_ns)):
        with pytest.raises(MapError, match="all 1 frames given have left the history"):
            pipeline.correct_poses({left: pose})
    for never in (frames[0].stamp_ns + 1, ("rooms", frames[1].stamp_ns), ("side", frames[0].stamp_ns)):
        for others in ({}, {("rooms", frames[2].stamp_ns): pose, ("rooms", frames[7].stamp_ns): pose}):
            with pytest.raises(MapError, match="no frame with this stamp was mapped"):
                pipeline.correct_poses({**others, never: pose})
    assert not pipeline.corrector.status.running
