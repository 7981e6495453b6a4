from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from research.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from semantic_mapper.drivers.base import CameraImage, PoseEstimate
from semantic_mapper.drivers.poses import loop_closure, odometry
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.errors import CameraError
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame
from tests.drawn_room import truth_of, walk_frames

from . import images
from .images import as_image

INTRINSICS = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)
CONFIG = OdometryPoses()


@cache
def walk(noisy: bool = False) -> tuple[PosedFrame, ...]:
    """Forty frames of 160x120 through a furnished room."""
    return walk_frames(7, 40, INTRINSICS, noisy=noisy)


@cache
def other_room(count: int) -> tuple[PosedFrame, ...]:
    return walk_frames(23, count, INTRINSICS)


def follow(frames: list[CameraImage], source: OdometryPoseSource) -> list[PoseEstimate | None]:
    with source:
        return [source.pose(frame) for frame in frames]


def poses_of(estimates: list[PoseEstimate | None]) -> Float64:
    assert all(e is not None for e in estimates)
    return np.array([e.T_world_camera for e in estimates if e is not None])


def truth() -> Float64:
    return truth_of(walk())


def started() -> OdometryPoseSource:
    rows = tuple(tuple(float(v) for v in row) for row in walk()[0].T_world_camera)
    return OdometryPoseSource(OdometryPoses(T_world_start=rows))


def test_a_camera_is_followed_through_a_room() -> None:
    source = started()
    estimates = follow([as_image(f) for f in walk()], source)
    found = poses_of(estimates)
    way = np.linalg.norm(np.diff(truth()[:, :3, 3], axis=0), axis=1).sum()
    assert way > 1.0
    assert absolute_trajectory_error(found, truth()).rmse_m < 0.01 * way
    assert relative_pose_error(found, truth()).rmse_deg < 0.3
    assert np.array_equal(found[0], truth()[0])
    assert source.counters["tracked"] == 40 and source.counters["keyframes"] > 2 and source.warnings == ()
    assert {e.source for e in estimates if e is not None} == {"odometry"}


def test_noisy_depth_is_followed_too_the_same_each_time_and_the_uncertainty_grows_with_the_way() -> None:
    frames = [as_image(f) for f in walk(noisy=True)]
    estimates = follow(frames, started())
    found = poses_of(estimates)
    assert np.array_equal(found[:15], poses_of(follow(frames[:15], started())))
    assert absolute_trajectory_error(found, truth()).rmse_m < 0.05
    off = np.linalg.norm(found[:, :3, 3] - truth()[:, :3, 3], axis=1)
    sigma = np.array([e.sigma for e in estimates if e is not None])
    assert sigma[0] == 0 and sigma[-1] > sigma[1] > 0
    assert np.mean(off[1:] < 3 * sigma[1:]) > 0.8


def test_a_blacked_out_stretch_is_lost_and_the_camera_found_again() -> None:
    frames = [as_image(f) for f in walk()]
    back = [replace(f, stamp_ns=f.stamp_ns + 10**10) for f in frames[:15]]  # a long time later, at the beginning again
    dark = [
        replace(f, rgb=np.zeros_like(f.rgb), depth_m=np.zeros_like(f.depth_m), stamp_ns=f.stamp_ns + 10**9)
        for f in frames[20:26]
    ]
    source = started()
    with source:
        assert all(source.pose(f) is not None for f in frames[:20])
        for f in dark:
            assert source.pose(f) is None
            assert "show the camera a place" in source.warnings[0]
        assert source.counters["lost"] == 6 and source.counters["relocalised"] == 0
        found = poses_of([source.pose(f) for f in back])
    assert source.counters["relocalised"] == 1 and source.warnings == ()
    assert np.linalg.norm(found[:, :3, 3] - truth()[:15, :3, 3], axis=1).max() < 0.02


def test_a_camera_that_stays_lost_begins_a_new_world_and_goes_on_there() -> None:
    here = [as_image(f) for f in walk()[:8]]
    there = [replace(as_image(f), stamp_ns=8 * 10**9 + k * 10**9) for k, f in enumerate(other_room(9))]
    source = OdometryPoseSource(CONFIG)
    (world,) = {e.world for e in follow(here, source) if e is not None}
    assert world > 0
    found = follow(there, source)
    assert found[:5] == [None] * 5  # it may see an old place again
    assert source.counters["new_sessions"] == 1 and source.warnings == ()
    later = [e for e in found[5:] if e is not None]
    assert len(later) == 4 and {e.world for e in later} == {world + 1}
    assert np.array_equal(later[0].T_world_camera, np.eye(4)) and source.counters["loops_closed"] == 0
    in_place = started()  # where the world is a given one, no other can begin
    follow(here, in_place)
    assert follow(there, in_place) == [None] * 9 and "new world" not in in_place.warnings[0]


def test_a_covered_lens_tells_of_no_other_place() -> None:
    here = [as_image(f) for f in walk()[:8]]
    dark = [replace(here[-1], depth_m=np.zeros((120, 160), np.float32), stamp_ns=k * 10**9) for k in range(2, 12)]
    there = [replace(as_image(f), stamp_ns=12 * 10**9 + k * 10**9) for k, f in enumerate(other_room(7))]
    source = OdometryPoseSource(CONFIG)
    (world,) = {e.world for e in follow(here, source) if e is not None}
    found = follow([*dark, *there], source)
    assert found[:14] == [None] * 14, "old places are looked for as long as without the dark"
    assert [e.world for e in found[14:] if e is not None] == [world + 1] * 3


def test_keyframes_that_have_gone_are_not_needed_when_a_world_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_closure, "MAX_KEYFRAMES", 5)
    monkeypatch.setattr(odometry, "KEYFRAME_M", 0.05)
    source = OdometryPoseSource(CONFIG)
    follow([as_image(f) for f in walk()], source)
    found = follow([replace(as_image(f), stamp_ns=8 * 10**9 + f.seq * 10**9) for f in other_room(15)], source)
    assert len({e.world for e in found if e is not None}) == 1 and source.counters["keyframes"] > 10
    source.correction(final=True)


def test_first_images_that_show_too_little_are_left_behind() -> None:
    frames = [as_image(f) for f in walk()[:6]]
    elsewhere = as_image(other_room(1)[0])
    source = OdometryPoseSource(CONFIG)
    found = follow([replace(elsewhere, stamp_ns=frames[0].stamp_ns - 10**7), *frames], source)
    first, *others = [e.world for e in found if e is not None]
    assert others == [first + 1] * 6 and source.counters["lost"] == 0


def blank_corner(x_m: float, number: int) -> CameraImage:
    """A wall 1 m ahead without a mark, and one beside it at x = -0.5 m; vertical all along."""
    rays = (np.arange(160) - INTRINSICS.cx) / INTRINSICS.fx
    with np.errstate(divide="ignore"):
        side = np.where(rays < 0, (-0.5 - x_m) / rays, np.inf)
    depth = np.tile(np.minimum(side, 1.0).astype(np.float32), (120, 1))
    grey = np.full((120, 160, 3), 90, np.uint8)
    return CameraImage(10**9 + number * 66_000_000, number, "cam", grey, depth, INTRINSICS)


def test_a_camera_that_stands_before_a_blank_wall_stays_but_is_not_sure() -> None:
    found = [e for e in follow([blank_corner(1.0, k) for k in range(40)], started()) if e is not None]
    assert len(found) == 40 and 0.14 < found[-1].sigma < 0.16
    assert np.allclose(found[-1].T_world_camera, found[0].T_world_camera, atol=1e-3)


def test_a_camera_without_depth_and_another_in_between_are_refused() -> None:
    with pytest.raises(CameraError, match=r"has no depth.*scale.*kind = \"topic\".*kind = \"device\""):
        OdometryPoseSource(CONFIG).pose(images.image(5, depth=False))
    source = OdometryPoseSource(CONFIG)
    first = as_image(walk()[0])
    source.pose(first)
    with pytest.raises(CameraError, match="a pose source of its own"):
        source.pose(replace(first, camera_id="other"))
