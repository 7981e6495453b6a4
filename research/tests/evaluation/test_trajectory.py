from __future__ import annotations

import numpy as np
import pytest

from research.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from semantic_mapper.geometry import make_pose
from semantic_mapper.types import Float64


def walk(rng: np.random.Generator, count: int = 40) -> Float64:
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ make_pose(rng.normal(0, 0.05, 3), rng.normal(0, 0.1, 3)))
    return np.array(poses)


def test_a_path_in_another_world_has_no_error(rng: np.random.Generator) -> None:
    truth = walk(rng)
    other = make_pose((0.3, -2.0, 1.1), (5, -3, 2)) @ truth
    assert absolute_trajectory_error(other, truth).max_m < 1e-12
    error = relative_pose_error(other, truth, 3)
    assert error.max_m < 1e-12 and error.rmse_deg < 1e-6


def test_errors_of_known_size() -> None:
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    estimated = truth.copy()
    estimated[:, :3, 3] += [[0.1, 0.1, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0]]  # shrunk: scale is held
    found = absolute_trajectory_error(estimated, truth)
    assert found.rmse_m == pytest.approx(np.sqrt(0.02)) and found.max_m == pytest.approx(np.sqrt(0.02))
    steps = relative_pose_error(estimated, truth)
    assert steps.rmse_m == pytest.approx(0.2) and steps.median_m == pytest.approx(0.2) and steps.rmse_deg == 0
