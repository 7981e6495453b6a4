from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from research.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from semantic_mapper.bundle.keyframes import BundleProblem, adjust_bundle
from semantic_mapper.bundle.refiner import PoseRefiner, RefinedPose
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.geometry import project
from semantic_mapper.types import Float64, PosedFrame

from .rooms import INTRINSICS, truth, walk

CONFIG = PoseRefinerConfig(sigma_m=0.02)


@cache
def disturbed() -> tuple[PosedFrame, ...]:
    """The walk with poses that are off by 2 cm and half a degree, each on its own."""
    rng = np.random.default_rng(3)
    frames = []
    for frame in walk():
        T = frame.T_world_camera.copy()
        T[:3, :3] = cv2.Rodrigues(np.radians(0.5) * rng.standard_normal(3))[0] @ T[:3, :3]
        T[:3, 3] += 0.02 / np.sqrt(3) * rng.standard_normal(3)
        frames.append(replace(frame, T_world_camera=T))
    return tuple(frames)


@cache
def refine() -> tuple[tuple[RefinedPose, ...], Float64, Float64]:
    """What became of each frame, the poses after all corrections, and those that given poses have in the mean."""
    refiner = PoseRefiner(INTRINSICS, CONFIG)
    found, final, anchored = [], {}, []
    for frame in disturbed():
        found.append(refiner.push(frame))
        anchored.append(refiner.to_given(found[-1].T_world_camera)[0])
        final[frame.camera_id, frame.stamp_ns] = found[-1].T_world_camera
        final |= refiner.corrections()
    return tuple(found), np.array(list(final.values())), np.array(anchored)


def test_disturbed_poses_come_nearer_to_the_truth_and_fit_the_pictures() -> None:
    found, final, anchored = refine()
    given = np.array([f.T_world_camera for f in disturbed()])
    assert absolute_trajectory_error(final, truth()).rmse_m < 0.6 * absolute_trajectory_error(given, truth()).rmse_m
    before, after = relative_pose_error(given, truth()), relative_pose_error(final, truth())
    assert after.rmse_m < 0.4 * before.rmse_m and after.rmse_deg < 0.3 * before.rmse_deg
    assert absolute_trajectory_error(anchored, truth()).rmse_m < 0.03
    assert relative_pose_error(anchored, truth()).rmse_m < 0.7 * before.rmse_m
    late = found[8:]
    assert np.mean([r.refined for r in late]) > 0.9
    assert np.median([r.error_px for r in late]) < 0.7 < np.median([r.given_error_px for r in late])


def test_the_scale_becomes_sure_as_the_camera_moves_and_given_poses_are_exact() -> None:
    def spreads(sigma_m: float) -> list[float]:
        refiner = PoseRefiner(INTRINSICS, PoseRefinerConfig(sigma_m=sigma_m))
        found = [refiner.scale_spread]
        for frame in walk():
            refiner.push(frame)
            found.append(refiner.scale_spread)
        return found

    exact, rough = spreads(0.01), spreads(0.04)
    assert np.isinf(exact[0]) and np.isinf(exact[1])
    assert exact[-1] < 0.5 * exact[8] and exact[-1] < 0.05
    assert rough[-1] == pytest.approx(4 * exact[-1], rel=0.2)


def test_two_runs_give_the_same_poses_bit_for_bit() -> None:
    found, _, _ = refine()
    refiner = PoseRefiner(INTRINSICS, CONFIG)
    again = [refiner.push(frame).T_world_camera for frame in disturbed()[:14]]
    assert all(np.array_equal(a, b.T_world_camera) for a, b in zip(again, found, strict=False))


def test_a_bundle_in_the_background_gives_poses_as_good() -> None:
    refiner = PoseRefiner(INTRINSICS, CONFIG, background=True)
    final = {}
    for frame in disturbed():
        final[frame.camera_id, frame.stamp_ns] = refiner.push(frame).T_world_camera
        final |= refiner.corrections()
    refiner.close()
    final |= refiner.corrections()
    given = np.array([f.T_world_camera for f in disturbed()])
    found = np.array(list(final.values()))
    assert relative_pose_error(found, truth()).median_m < 0.6 * relative_pose_error(given, truth()).median_m


def test_pictures_without_corners_leave_given_poses_as_they_are() -> None:
    refiner = PoseRefiner(INTRINSICS, CONFIG)
    for frame in disturbed()[:6]:
        result = refiner.push(replace(frame, rgb=np.full_like(frame.rgb, 90)))
        assert not result.refined and np.isnan(result.given_error_px)
        assert np.allclose(result.T_world_camera, frame.T_world_camera, atol=1e-9)
    assert refiner.corrections() == {}


def test_a_bundle_finds_poses_and_points_from_their_pixels(rng: np.random.Generator) -> None:
    points = rng.uniform((-2, -1.5, 2), (2, 1.5, 5), (60, 3))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(5)
    keyframe, point = (index.ravel() for index in np.indices((5, 60)))
    pixels = project(points[point] - poses[keyframe, :3, 3], INTRINSICS)
    pixels[7] += 40  # one is wrong
    guess = poses.copy()
    guess[1:, :3, 3] += 0.02 * rng.standard_normal((4, 3))
    priors, sigmas = guess.copy(), np.full((5, 2), np.inf)
    priors[-1], sigmas[-1] = poses[-1], (1e-3, 1e-3)  # tells the scale
    held = np.arange(5) == 0
    moved = points + 0.1 * rng.standard_normal(points.shape)
    problem = BundleProblem(INTRINSICS, guess, held, priors, sigmas, moved, keyframe, point, pixels)
    found = adjust_bundle(problem, 30)
    assert np.abs(found.poses[:, :3, 3] - poses[:, :3, 3]).max() < 1e-3
    assert np.abs(np.delete(found.points, point[7], axis=0) - np.delete(points, point[7], axis=0)).max() < 0.02
    assert found.errors_px[7] > 20 and np.median(found.errors_px) < 0.01
