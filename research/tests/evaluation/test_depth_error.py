from __future__ import annotations

import numpy as np
import pytest

from research.evaluation.depth_error import DepthErrors, depth_errors
from semantic_mapper.errors import ShapeError


def test_depth_errors_by_hand() -> None:
    #                  +0.5   -1    exact  no truth  unknown
    truth = np.array([[1.0, 4.0, 2.0, 0.0, 3.0]], np.float32)
    rendered = np.array([[1.5, 3.0, 2.0, 9.0, 0.0]], np.float32)
    known = np.array([[True, True, True, True, False]])
    found = depth_errors(truth, rendered, known)
    assert found.count == 3
    assert found.abs_rel == pytest.approx((0.5 + 0.25 + 0) / 3)
    assert found.rmse_m == pytest.approx(np.sqrt((0.25 + 1) / 3))


def test_errors_of_two_images_add_up_to_those_of_both_together(rng: np.random.Generator) -> None:
    truth = rng.uniform(0, 5, (2, 6, 8)).astype(np.float32)
    rendered = (truth + rng.normal(0, 0.2, truth.shape)).astype(np.float32)
    known = rng.random(truth.shape) < 0.8
    summed = depth_errors(truth[0], rendered[0], known[0]) + depth_errors(truth[1], rendered[1], known[1])
    whole = depth_errors(truth.reshape(12, 8), rendered.reshape(12, 8), known.reshape(12, 8))
    assert summed.count == whole.count
    assert summed.abs_rel == pytest.approx(whole.abs_rel) and summed.rmse_m == pytest.approx(whole.rmse_m)


def test_nothing_to_compare_gives_no_figures() -> None:
    assert DepthErrors().abs_rel is None and DepthErrors().rmse_m is None


def test_images_of_another_size_are_refused() -> None:
    with pytest.raises(ShapeError, match="differ"):
        depth_errors(np.ones((2, 3), np.float32), np.ones((3, 2), np.float32), np.ones((2, 3), bool))
