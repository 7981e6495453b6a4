from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.trajectory import align_rigid, align_similar
from semantic_mapper.geometry import make_pose
from semantic_mapper.types import Float64


def test_alignment_is_the_best_there_is(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    best = align_rigid(a, b)

    def cost(T: Float64) -> float:
        return float(((a @ T[:3, :3].T + T[:3, 3] - b) ** 2).sum())

    assert np.allclose(best[:3, :3] @ best[:3, :3].T, np.eye(3)) and np.linalg.det(best[:3, :3]) > 0
    for _ in range(300):
        assert cost(best @ make_pose(rng.normal(0, 0.02, 3), rng.normal(0, 0.02, 3))) >= cost(best)


def test_alignment_with_scale_finds_the_similarity_and_refuses_a_single_place(rng: np.random.Generator) -> None:
    a, T = rng.normal(size=(30, 3)), make_pose((0.3, -2.0, 1.1), (5, -3, 2))
    found, scale = align_similar(a, 2.5 * a @ T[:3, :3].T + T[:3, 3])
    assert scale == pytest.approx(2.5) and np.allclose(found, T)
    with pytest.raises(ShapeError, match="not all one"):
        align_similar(np.ones((5, 3)), a[:5])
    for some, others in ((a[:5], a[:4]), (a[:2], a[:2])):
        with pytest.raises(ShapeError, match="as many points"):
            align_rigid(some, others)
