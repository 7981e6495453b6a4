"""Sparse convolutions against torch's dense ones."""

import numpy as np
import torch
from torch.nn.functional import conv3d, conv_transpose3d

from semantic_mapper.fields.nesf import Down, SubmanifoldConv, Up, cell_levels

SIZE = (8, 4, 12)


def _all_cells() -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(s) for s in SIZE), indexing="ij"), -1).reshape(-1, 3) - 4


def _kernel(weight: torch.Tensor, side: int, out_first: bool = True) -> torch.Tensor:
    """Weights (side^3, in, out) as torch's dense convolutions have them."""
    return weight.view(side, side, side, *weight.shape[1:]).permute(*((4, 3) if out_first else (3, 4)), 0, 1, 2)


def test_down_and_up_over_all_cells_are_the_dense_ones() -> None:
    torch.manual_seed(0)
    down, up = Down(3, 5), Up(5, 3)
    level = cell_levels(_all_cells(), 1)[0]
    x = torch.randn(len(_all_cells()), 3)
    dense = conv3d(x.T.reshape(1, 3, *SIZE), _kernel(down.weight, 2), down.bias, stride=2)
    finer = conv_transpose3d(dense, _kernel(up.weight, 2, out_first=False), up.bias, stride=2)
    coarse = down(x, level)
    torch.testing.assert_close(coarse, dense[0].reshape(5, -1).T, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(up(coarse, level), finer[0].reshape(3, -1).T, atol=1e-5, rtol=1e-5)


def test_absent_cells_count_as_zeros_and_so_do_their_gradients() -> None:
    torch.manual_seed(3)
    rng = np.random.default_rng(0)
    every = _all_cells()
    kept = np.sort(rng.choice(len(every), len(every) // 3, replace=False))
    conv, weight = SubmanifoldConv(3, 4), torch.randn(len(kept), 4)
    x = torch.randn(len(kept), 3, requires_grad=True)
    sparse = conv(x, cell_levels(every[kept], 1)[0])
    full = torch.zeros(len(every), 3).index_copy(0, torch.from_numpy(kept), x)
    dense = conv3d(full.T.reshape(1, 3, *SIZE), _kernel(conv.weight, 3), conv.bias, padding=1)
    dense = dense[0].reshape(4, -1).T[kept]
    torch.testing.assert_close(sparse, dense, atol=1e-5, rtol=1e-5)
    mine = torch.autograd.grad((sparse * weight).sum(), [x, conv.weight])
    theirs = torch.autograd.grad((dense * weight).sum(), [x, conv.weight])
    for a, b in zip(mine, theirs, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)
    # Where the input wants no gradient, that of the weights is found in another way.
    alone = torch.autograd.grad((conv(x.detach(), cell_levels(every[kept], 1)[0]) * weight).sum(), conv.weight)[0]
    torch.testing.assert_close(alone, theirs[1], atol=1e-4, rtol=1e-4)
