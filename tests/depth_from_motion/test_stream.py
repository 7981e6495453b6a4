"""Depth of streams: exact on a textured plane, none where the camera only turns, no frame lost."""

from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.stream import MAX_CAMERAS, MAX_VIEWS, DepthFromMotion
from semantic_mapper.depth_from_motion.views import DepthEstimate
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.depth_from_motion.pictures import CAMERA, plane_frame

CONFIG = DepthFromMotionConfig(width=64, near_m=0.8, far_m=6.0)


def walk(count: int, *, gain: float = 1.0, **kwargs: object) -> list[tuple[PosedFrame, np.ndarray]]:
    """A camera that moves sideways, 8 cm a frame; every second picture has the gain."""
    ways = [0.08 * k for k in range(count)]
    return [
        plane_frame(x, 0.2 * x, seq=k, gain=gain if k % 2 else 1.0, **kwargs)  # type: ignore[arg-type]
        for k, x in enumerate(ways)
    ]


def relative_error(frame: PosedFrame, truth: np.ndarray) -> float:
    assert frame.depth_m is not None and (frame.depth_m > 0).all()
    return float(np.median(np.abs(frame.depth_m - truth) / truth))


@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_a_camera_that_moves_sideways_finds_depth_whatever_the_exposure(gain: float) -> None:
    stream = DepthFromMotion(CONFIG)
    frames = walk(8, gain=gain)
    done = [ready for frame, _ in frames for ready in stream.push(frame)]
    assert [f.seq for f in done] == list(range(8))
    assert done[0].depth_m is not None and not done[0].depth_m.any()  # nothing came before it
    for frame, (_, truth) in list(zip(done, frames, strict=True))[4:]:
        assert relative_error(frame, truth) < 0.02
        assert frame.depth_sigma_m is not None and (frame.depth_sigma_m > 0).all()


def test_a_delayed_frame_is_seen_from_both_sides_and_none_is_lost() -> None:
    stream = DepthFromMotion(DepthFromMotionConfig(width=64, near_m=0.8, far_m=6.0, delay_frames=3))
    frames = walk(6)
    ready = [[f.seq for f in stream.push(frame)] for frame, _ in frames]
    assert ready == [[], [], [], [0], [1], [2]]
    rest = stream.finish()
    assert [f.seq for f in rest] == [3, 4, 5] and not stream.finish()
    assert relative_error(rest[0], frames[3][1]) < 0.02


def test_depth_is_computed_from_corrected_poses_of_frames_before_and_frames_that_wait_come_out_there() -> None:
    config = DepthFromMotionConfig(width=64, near_m=0.8, far_m=6.0, delay_frames=3)
    frames = [frame for frame, _ in walk(6)]

    def off(frame: PosedFrame) -> PosedFrame:
        T = frame.T_world_camera.copy()
        T[0, 3] *= 0.8  # ways too short: depth, too
        return replace(frame, T_world_camera=T)

    right, corrected, wrong = (DepthFromMotion(config) for _ in range(3))
    for frame in frames:
        right.push(frame), wrong.push(off(frame))
        corrected.push(off(frame))
        corrected.correct_poses(
            {(f.camera_id, f.stamp_ns): f.T_world_camera for f in frames} | {("other", 1): np.eye(4)}
        )
    for a, b, c in zip(right.finish(), corrected.finish(), wrong.finish(), strict=True):
        assert np.array_equal(a.T_world_camera, b.T_world_camera)
        assert a.depth_m is not None and b.depth_m is not None and c.depth_m is not None
        assert np.median(np.abs(b.depth_m / a.depth_m - 1)) < 0.01 < np.median(np.abs(c.depth_m / a.depth_m - 1))


@pytest.mark.parametrize("turn", [0.0, 0.05])
def test_a_camera_that_turns_or_stands_has_no_depth_and_keeps_its_frames(turn: float) -> None:
    stream = DepthFromMotion(CONFIG)
    for k in range(40):
        (done,) = stream.push(plane_frame(turn=turn * k % 0.3, seq=k)[0])
        assert done.depth_m is not None and not done.depth_m.any()
        assert done.depth_sigma_m is not None and not done.depth_sigma_m.any()


def test_depth_of_a_sensor_passes_through_unchanged_and_in_order() -> None:
    stream = DepthFromMotion(DepthFromMotionConfig(width=64, delay_frames=2))
    frames = [frame for frame, _ in walk(4)]
    measured = replace(frames[1], depth_m=np.ones(frames[1].rgb.shape[:2], np.float32))
    done = [ready for f in (frames[0], measured, *frames[2:]) for ready in stream.push(f)]
    assert [f.seq for f in done] == [0, 1] and done[1] is measured
    assert not stream.push(plane_frame(camera_id="gone")[0])  # it does not hold up the others
    done = [ready.camera_id for frame, _ in walk(12, camera_id="here") for ready in stream.push(frame)]
    assert done[2] == "gone" and len(done) + len(stream.finish()) == 15


def test_a_hint_decides_where_the_picture_says_nothing_and_only_there() -> None:
    frames = [plane_frame(0.1 * k, seq=k) for k in range(4)]
    plain = [replace(frame, rgb=np.full_like(frame.rgb, 90)) for frame, _ in frames]
    truth = frames[-1][1]
    asked: list[CameraIntrinsics] = []

    def hint(frame: PosedFrame, intrinsics: CameraIntrinsics) -> DepthEstimate:
        asked.append(intrinsics)
        return DepthEstimate(truth.copy(), np.full_like(truth, 0.02))

    stream = DepthFromMotion(CONFIG)
    done = [ready for frame in plain for ready in stream.push(frame, hint)]
    assert relative_error(done[-1], truth) < 0.06  # near the hint to about a plane
    assert asked[-1].width == 64

    def wrong(frame: PosedFrame, intrinsics: CameraIntrinsics) -> DepthEstimate:
        depth = 1.5 * textured[frame.seq][1]
        return DepthEstimate(depth, 0.03 * depth)

    textured, stream = walk(6), DepthFromMotion(CONFIG)
    done = [ready for frame, _ in textured for ready in stream.push(frame, wrong)]
    assert relative_error(done[-1], textured[-1][1]) < 0.03  # does not outweigh the picture


def test_the_spread_is_larger_where_the_picture_says_nothing() -> None:
    plain = np.zeros(CAMERA.height * CAMERA.width, np.bool_).reshape(CAMERA.height, CAMERA.width)
    stream = DepthFromMotion(CONFIG)
    for k in range(6):
        frame, _ = plane_frame(0.08 * k, seq=k)
        rgb = frame.rgb.copy()
        rgb[:, :24] = 90
        (done,) = stream.push(replace(frame, rgb=rgb))
    plain[:, :18] = True
    assert done.depth_m is not None and done.depth_sigma_m is not None
    spread = done.depth_sigma_m / done.depth_m
    assert np.median(spread[plain]) > 2 * np.median(spread[:, 32:])


def test_memory_is_bounded_and_old_places_are_kept() -> None:
    stream = DepthFromMotion(CONFIG)
    for k in range(2 * MAX_CAMERAS):
        stream.push(plane_frame(camera_id=f"other {k}")[0])
    for k in range(3 * MAX_VIEWS):
        stream.push(plane_frame(min(0.05 * k, 0.5), seq=k)[0])
    assert len(stream._cameras) == MAX_CAMERAS
    views = stream._cameras["cam"].views
    assert len(views) == MAX_VIEWS and views[0].stamp_ns == 100_000_000
