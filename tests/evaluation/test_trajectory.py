from __future__ import annotations

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.trajectory import (
    absolute_trajectory_error,
    align_rigid,
    align_similar,
    relative_pose_error,
)
from semantic_mapper.types import Float64


def rigid(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> Float64:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array(turn))[0]
    T[:3, 3] = shift
    return T


def walk(rng: np.random.Generator, count: int = 40) -> Float64:
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ rigid(tuple(rng.normal(0, 0.05, 3)), tuple(rng.normal(0, 0.1, 3))))
    return np.array(poses)


def test_a_path_in_another_world_has_no_error(rng: np.random.Generator) -> None:
    truth = walk(rng)
    other = rigid((0.3, -2.0, 1.1), (5, -3, 2)) @ truth
    assert absolute_trajectory_error(other, truth).max_m < 1e-12
    error = relative_pose_error(other, truth, 3)
    assert error.max_m < 1e-12 and error.rmse_deg < 1e-6


def test_alignment_is_the_best_there_is(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    best = align_rigid(a, b)

    def cost(T: Float64) -> float:
        return float(((a @ T[:3, :3].T + T[:3, 3] - b) ** 2).sum())

    assert np.allclose(best[:3, :3] @ best[:3, :3].T, np.eye(3)) and np.linalg.det(best[:3, :3]) > 0
    for _ in range(300):
        assert cost(best @ rigid(tuple(rng.normal(0, 0.02, 3)), tuple(rng.normal(0, 0.02, 3)))) >= cost(best)


def test_alignment_with_scale_finds_the_similarity_and_refuses_a_single_place(rng: np.random.Generator) -> None:
    a, T = rng.normal(size=(30, 3)), rigid((0.3, -2.0, 1.1), (5, -3, 2))
    found, scale = align_similar(a, 2.5 * a @ T[:3, :3].T + T[:3, 3])
    assert scale == pytest.approx(2.5) and np.allclose(found, T)
    with pytest.raises(ShapeError, match="not all one"):
        align_similar(np.ones((5, 3)), a[:5])


def test_errors_of_known_size() -> None:
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    estimated = truth.copy()
    estimated[:, :3, 3] += [[0.1, 0.1, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0]]  # shrunk: scale is held
    found = absolute_trajectory_error(estimated, truth)
    assert found.rmse_m == pytest.approx(np.sqrt(0.02)) and found.max_m == pytest.approx(np.sqrt(0.02))
    steps = relative_pose_error(estimated, truth)
    assert steps.rmse_m == pytest.approx(0.2) and steps.median_m == pytest.approx(0.2) and steps.rmse_deg == 0


def test_paths_that_do_not_belong_together_are_refused(rng: np.random.Generator) -> None:
    truth = walk(rng, 5)
    for poses, others in ((truth[:4], truth), (truth[:2], truth[:2])):
        with pytest.raises(ShapeError, match="as many points"):
            absolute_trajectory_error(poses, others)
    with pytest.raises(ShapeError, match="gap 5"):
        relative_pose_error(truth, truth, 5)
