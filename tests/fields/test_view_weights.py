import pytest
import torch

from semantic_mapper.fields.view_weights import constrained_weights, softmax_weights


@pytest.mark.parametrize("views", [1, 2, 5, 8, 16])
@pytest.mark.parametrize("tau", [0.02, 0.3, 0.9])
def test_weights_lie_strictly_within_the_bounds_of_eq_12(views: int, tau: float):
    score = torch.randn(views, 1000, dtype=torch.float64) * 10
    w = constrained_weights(score, torch.ones_like(score, dtype=torch.bool), tau)
    torch.testing.assert_close(w.sum(0), torch.ones(1000, dtype=torch.float64))
    assert (w > tau / views).all()
    assert (w < 1 / (tau * views)).all()


def test_bounds_count_only_valid_views():
    score = torch.randn(6, 200, dtype=torch.float64) * 10
    valid = torch.rand(6, 200) < 0.5
    w = constrained_weights(score, valid, 0.1)
    seen = valid.sum(0)
    assert (w[~valid] == 0).all()
    assert (w[:, seen == 0] == 0).all()
    lower = (0.1 / seen).expand(6, 200)[valid]
    upper = (1 / (0.1 * seen)).expand(6, 200)[valid]
    assert (w[valid] > lower).all() and (w[valid] < upper).all()


def test_equal_scores_give_equal_weights_and_a_higher_score_a_higher_weight():
    valid = torch.ones(2, 1, dtype=torch.bool)
    torch.testing.assert_close(constrained_weights(torch.zeros(2, 1), valid, 0.02), torch.full((2, 1), 0.5))
    w = constrained_weights(torch.tensor([[1.0], [-1.0]]), valid, 0.02)
    assert w[0] > 0.9


def test_smaller_tau_lets_weights_deviate_more_from_uniform():
    score, valid = torch.tensor([[5.0], [-5.0]]), torch.ones(2, 1, dtype=torch.bool)
    assert constrained_weights(score, valid, 0.01)[0] > constrained_weights(score, valid, 0.5)[0]


def test_weight_constraint_passes_gradcheck():
    score = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[True] * 4, [True, False, True, True], [True, True, False, False]])
    assert torch.autograd.gradcheck(lambda s: constrained_weights(s, valid, 0.1), (score,))
    assert torch.autograd.gradcheck(lambda s: softmax_weights(s, valid), (score,))
