from dataclasses import replace

import numpy as np
import pytest

from research.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import VisualPoses
from semantic_mapper.drivers.poses.visual import VisualPoseSource, two_views
from semantic_mapper.geometry import look_at, project
from semantic_mapper.nodes.camera.live import with_poses
from semantic_mapper.nodes.options import LiveCamera
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import Float64
from tests.bundle.rooms import INTRINSICS, truth, walk, way_m

from .images import ListCamera, as_image

CONFIG = VisualPoses()


class Wheels(PoseSource):
    """Odometry whose ways are 2 % too long."""

    def __init__(self) -> None:
        super().__init__()
        self._warnings = ("a wheel squeaks",)
        self._counters["messages"] = 7
        poses = truth()
        poses[:, :3, 3] = poses[0, :3, 3] + 1.02 * (poses[:, :3, 3] - poses[0, :3, 3])
        self._poses = {f.stamp_ns: T for f, T in zip(walk(), poses, strict=True)}

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        T = self._poses.get(image.stamp_ns)
        return None if T is None else PoseEstimate(T, "topic", 0.02)


def follow(source: VisualPoseSource, count: int) -> list[PoseEstimate | None]:
    with source:
        return [source.pose(as_image(f)) for f in walk()[:count]]


def poses_of(estimates: list[PoseEstimate | None]) -> tuple[Float64, Float64]:
    """Found and true poses of the frames that have one."""
    known = [i for i, e in enumerate(estimates) if e is not None]
    return np.array([e.T_world_camera for e in estimates if e is not None]), truth()[known]


def way_of(poses: Float64) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def test_coarse_wheels_tell_the_scale_and_where_the_world_is() -> None:
    source = VisualPoseSource(CONFIG, Wheels())
    assert source.scale == "awaited"
    estimates = follow(source, 30)
    found, true = poses_of(estimates)
    assert len(found) > 8 and source.scale == "known"
    assert absolute_trajectory_error(found, true).rmse_m < 0.03 * way_m()
    assert np.linalg.norm(found[0, :3, 3] - true[0, :3, 3]) < 0.1  # in the world of the wheels
    assert {e.source for e in estimates if e is not None} == {"visual"}
    assert source.counters["without_scale"] > 0 and source.counters["scale_messages"] == 7
    assert "a wheel squeaks" in source.warnings


def test_without_anything_the_poses_are_up_to_scale_and_the_status_says_so() -> None:
    source = VisualPoseSource(CONFIG)
    found, true = poses_of(follow(source, 30))
    assert source.scale == "unknown" and source.warnings[0].startswith("scale: unknown")
    assert len(found) > 24 and source.counters["tracked"] == len(found) and source.counters["keyframes"] > 4
    found[:, :3, 3] *= way_of(true) / way_of(found)
    assert absolute_trajectory_error(found, true).rmse_m < 0.02 * way_m()
    assert relative_pose_error(found, true).rmse_deg < 0.4


def test_a_camera_announces_that_its_poses_are_not_in_metres() -> None:
    def announced(**config: object) -> StreamInfo:
        return with_poses(ListCamera([]), LiveCamera(kind="v4l2", poses={"kind": "visual", **config}), {}).info

    assert not announced().scale_known and announced().source == "list"
    assert announced(camera_height_m=1.0).scale_known and announced(scale={"kind": "board"}).scale_known


def test_the_height_over_a_floor_that_is_seen_tells_the_scale_and_where_the_floor_is() -> None:
    start = tuple(tuple(row) for row in walk()[0].T_world_camera.tolist())
    height_m = float(walk()[0].T_world_camera[2, 3])
    source = VisualPoseSource(VisualPoses(camera_height_m=height_m, T_world_start=start))
    assert source.scale == "awaited"
    estimates = follow(source, 30)
    found, true = poses_of(estimates)
    assert source.scale == "known" and len(found) >= 6 and estimates[-1] is not None
    assert way_of(found) == pytest.approx(way_of(true), rel=0.1)
    assert np.abs(found[:, 2, 3] - true[:, 2, 3]).max() < 0.1


def test_without_a_floor_in_sight_the_scale_is_awaited_and_the_status_says_for_what() -> None:
    upside_down = ((0.0, 0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    source = VisualPoseSource(VisualPoses(camera_height_m=1.1, T_world_start=upside_down))
    assert not any(follow(source, 15)) and source.scale == "awaited" and "see the floor" in source.warnings[0]


def test_a_lost_camera_says_why_and_is_found_back_where_it_was_before() -> None:
    source = VisualPoseSource(CONFIG)
    before = follow(source, 20)
    dark = as_image(walk()[0])
    assert source.pose(replace(dark, rgb=np.zeros_like(dark.rgb), stamp_ns=10**10)) is None
    assert "lost (pictures are too dark" in source.warnings[0]
    assert source.counters["lost"] == source.counters["dark"] == 1
    noise = np.random.default_rng(1).integers(0, 255, (3, 240, 320, 3)).astype(np.uint8)
    for k, picture in enumerate(noise):  # another room is not taken for this one
        assert source.pose(replace(dark, rgb=picture, stamp_ns=10**10 + k + 1)) is None
    again = [source.pose(replace(as_image(walk()[i]), stamp_ns=2 * 10**10 + walk()[i].stamp_ns)) for i in (12, 13, 14)]
    assert source.counters["relocalised"] == 1
    places = [None if e is None else e.T_world_camera[:3, 3] for e in (*before[10:17], *again)]
    first, there, last, back = places[0], places[2:5], places[6], places[7:]
    assert first is not None and last is not None
    for a, b in zip(there, back, strict=True):
        assert a is not None and b is not None
        assert np.linalg.norm(a - b) < 0.4 * np.linalg.norm(last - first)  # the processor's arithmetic decides digits


def test_a_camera_that_only_turns_or_sees_one_plane_begins_no_world(rng: np.random.Generator) -> None:
    points = rng.uniform((-2, -2, 2), (2, 2, 5), (200, 3))
    turned = look_at(np.zeros(3), np.array((0.1, 0.0, 1.0)), np.array((0.0, -1.0, 0.0)))
    seen = project(points @ turned[:3, :3], INTRINSICS) + 0.2 * rng.standard_normal((200, 2))
    assert two_views(project(points, INTRINSICS), seen, INTRINSICS) is None
    found = two_views(project(points, INTRINSICS), project(points - (0.3, 0.0, 0.0), INTRINSICS), INTRINSICS)
    assert found is not None and np.allclose(found[0][:3, 3], (1, 0, 0), atol=0.01)
    points[:, 2] = 2 + 0.3 * points[:, 0]
    wall = project(points, INTRINSICS), project(points - (0.3, 0.0, 0.0), INTRINSICS)
    assert two_views(*wall, INTRINSICS) is None
