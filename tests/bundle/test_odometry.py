from __future__ import annotations

import cv2
import numpy as np

from semantic_mapper.bundle.odometry import VisualOdometry, two_views
from semantic_mapper.bundle.scale import ScaleEstimator
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from semantic_mapper.geometry import invert_pose, look_at, project, transform
from semantic_mapper.types import Float64

from .rooms import INTRINSICS, truth, walk, way_m

CONFIG = PoseRefinerConfig(corners=200)


def follow(odometry: VisualOdometry, frames: range) -> Float64:
    """Poses; NaN where there is none."""
    found = [odometry.push(walk()[i].rgb, walk()[i].stamp_ns) for i in frames]
    return np.array([np.full((4, 4), np.nan) if T is None else T for T in found])


def in_metres(poses: Float64, frames: Float64) -> Float64:
    """The poses in the unit that brings their ways nearest to the true ones."""
    scaled = poses.copy()
    ways = [np.linalg.norm(np.diff(p[:, :3, 3], axis=0), axis=1).sum() for p in (frames, poses)]
    scaled[:, :3, 3] *= ways[0] / ways[1]
    return scaled


def test_a_camera_is_followed_up_to_scale() -> None:
    odometry = VisualOdometry(INTRINSICS, CONFIG)
    poses = follow(odometry, range(30))
    known = np.isfinite(poses[:, 0, 0])
    assert known.sum() > 24 and known[6:].all()
    assert odometry.counters["tracked"] == known.sum() and odometry.counters["keyframes"] > 4
    found, true = in_metres(poses[known], truth()[known]), truth()[known]
    assert absolute_trajectory_error(found, true).rmse_m < 0.02 * way_m()
    assert relative_pose_error(found, true).rmse_deg < 0.4


def test_a_lost_camera_is_found_back_where_it_was_before() -> None:
    odometry = VisualOdometry(INTRINSICS, CONFIG)
    before = follow(odometry, range(20))
    assert odometry.push(np.zeros_like(walk()[0].rgb), 10**10) is None and odometry.lost
    again = [odometry.push(walk()[i].rgb, 10**10 + walk()[i].stamp_ns) for i in (12, 13, 14)]
    assert odometry.counters["relocalised"] == 1 and not odometry.lost
    unit = np.linalg.norm(before[16, :3, 3] - before[10, :3, 3])
    for i, T in zip((12, 13, 14), again, strict=True):
        assert T is not None
        assert np.linalg.norm(T[:3, 3] - before[i, :3, 3]) < 0.4 * unit  # the processor's arithmetic decides digits


def test_another_room_is_not_taken_for_the_one_that_was_seen() -> None:
    odometry = VisualOdometry(INTRINSICS, CONFIG)
    follow(odometry, range(12))
    noise = np.random.default_rng(1).integers(0, 255, (3, 240, 320, 3)).astype(np.uint8)
    assert [odometry.push(image, 10**10 + i) for i, image in enumerate(noise)] == [None] * 3
    assert odometry.counters["lost"] == 3


def test_a_camera_that_only_turns_begins_no_world(rng: np.random.Generator) -> None:
    points = rng.uniform((-2, -2, 2), (2, 2, 5), (200, 3))
    turned = look_at(np.zeros(3), np.array((0.1, 0.0, 1.0)), np.array((0.0, -1.0, 0.0)))
    seen = project(points @ turned[:3, :3], INTRINSICS) + 0.2 * rng.standard_normal((200, 2))
    assert two_views(project(points, INTRINSICS), seen, INTRINSICS) is None
    moved = project(points - (0.3, 0.0, 0.0), INTRINSICS)
    found = two_views(project(points, INTRINSICS), moved, INTRINSICS)
    assert found is not None and np.allclose(found[0][:3, 3], (1, 0, 0), atol=0.01)


def test_the_scale_is_that_of_long_ways_and_follows_a_change_of_unit(rng: np.random.Generator) -> None:
    estimator = ScaleEstimator()
    place, scale = np.zeros(3), 1.7
    for step in range(100):
        place = place + 0.05 * np.array((np.cos(step / 9), np.sin(step / 9), 0.0))
        jitter = 0.002 * rng.standard_normal(3)
        estimator.add(place + jitter, place / scale)
        assert step > 10 or estimator.scale() is None
    found = estimator.scale()
    assert found is not None and abs(found / scale - 1) < 0.01
    T = np.eye(4)
    T[:3, 3] = place / scale
    estimator.rescaled(scale, T, T)
    assert abs((estimator.scale() or 0) - 1) < 0.01
    estimator.interrupt()
    estimator.add(np.full(3, 9.0), np.zeros(3))  # elsewhere in both
    assert abs((estimator.scale() or 0) - 1) < 0.01


def test_before_a_flat_wall_a_third_view_tells_which_of_two_motions_it_was() -> None:
    """Two views of one plane have two explanations; begun with the wrong one, the world is a twisted one."""
    rng = np.random.default_rng(0)
    alone, decided = list[bool](), list[bool]()
    for _ in range(60):
        slope = rng.uniform(-0.6, 0.6, 2)
        xy = rng.uniform(-1, 1, (150, 2)) * (1.2, 0.9)
        wall = np.column_stack((xy, 2 + xy @ slope))
        b, between = np.eye(4), np.eye(4)
        b[:3, :3], between[:3, :3] = (cv2.Rodrigues(rng.normal(0, 0.05, 3))[0] for _ in range(2))
        way = rng.normal(size=3)
        b[:3, 3] = way / np.linalg.norm(way) * rng.uniform(0.2, 0.6)
        between[:3, 3] = b[:3, 3] / 2 + rng.normal(0, 0.02, 3)
        pixels = [
            project(transform(invert_pose(T), wall), INTRINSICS) + rng.normal(0, 0.2, (150, 2))
            for T in (np.eye(4), b, between)
        ]
        for answers, third in ((alone, None), (decided, pixels[2])):
            found = two_views(pixels[0], pixels[1], INTRINSICS, third)
            if found is not None:
                cosine = found[0][:3, 3] @ b[:3, 3] / np.linalg.norm(found[0][:3, 3]) / np.linalg.norm(b[:3, 3])
                answers.append(bool(cosine > 0.96))
    assert len(alone) < 45 and alone.count(False) <= 5  # often one of the two has points behind a camera
    assert decided.count(True) >= 40 and decided.count(False) <= 5
