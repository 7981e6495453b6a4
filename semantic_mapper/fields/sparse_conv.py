"""Convolutions over the occupied cells of a 3D grid, in plain torch: neighbour tables, gathers, matrix products.

A *submanifold* convolution gives an output where there is an input and nowhere else (Graham et al. 2018), so a surface
stays a surface however many layers follow. Missing neighbours count as zeros.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

CHUNK_ROWS = 1024  # gathered at a time: 27 rows of features each, which stay in the cache
MAX_BOX = 100  # entries a cell of a table of all cells of a box
OFFSETS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], np.int64)  # (27, 3)
_BITS, _HALF = 21, 1 << 20  # a packed coordinate


class CellLevel(NamedTuple):
    """The occupied cells of one resolution.

    Args:
        cells: (N, 3) int64 coordinates, in lexicographic order.
        neighbours: (N, 27) int64 rows of the cells round each, in the order of ``OFFSETS``; N = not occupied.
        parent: (N,) int64 row in the next coarser level, which has ``parents`` cells.
        corner: (N,) int64 which of the parent's eight.
        parents: Cells of the next coarser level.
    """

    cells: NDArray[np.int64]
    neighbours: torch.Tensor
    parent: torch.Tensor
    corner: torch.Tensor
    parents: int


def pack_cells(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys (N,) int64 of cells (N, 3), in the same order; coordinates within +-2^20."""
    shifted = cells + _HALF
    return (shifted[..., 0] << (2 * _BITS)) | (shifted[..., 1] << _BITS) | shifted[..., 2]


def find_rows(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each of ``wanted`` stands in sorted ``keys`` (N,); N = nowhere."""
    rows = np.searchsorted(keys, wanted)
    found = keys[np.minimum(rows, len(keys) - 1)] == wanted
    return np.where(found, rows, len(keys))


def cell_levels(cells: NDArray[np.int64], count: int) -> tuple[CellLevel, ...]:
    """Tables of ``count`` resolutions, each half the one before.

    Args:
        cells: (N, 3) of the finest, unique and in lexicographic order; N > 0.
    """
    levels: list[CellLevel] = []
    for _ in range(count):
        coarse, parent = _unique_cells(cells >> 1)
        corner = (cells & 1) @ np.array((4, 2, 1))
        neighbours, up, place = (torch.from_numpy(t) for t in (_neighbours(cells), parent, corner))
        levels.append(CellLevel(cells, neighbours, up, place, len(coarse)))
        cells = coarse
    return tuple(levels)


def _unique_cells(cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    _, first, inverse = np.unique(pack_cells(cells), return_index=True, return_inverse=True)
    return cells[first], inverse.reshape(-1)


def _neighbours(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows (N, 27) of the cells round each; looked up in a box round all cells where that is small, else searched."""
    low = cells.min(0) - 1
    shape = cells.max(0) - low + 2
    if math.prod(map(int, shape)) > MAX_BOX * len(cells):
        return _searched_neighbours(cells)
    stride = np.array((shape[1] * shape[2], shape[2], 1))
    place = (cells - low) @ stride
    box = np.full(int(np.prod(shape)), len(cells), np.int64)
    box[place] = np.arange(len(cells))
    return box[place[:, None] + OFFSETS @ stride]


def _searched_neighbours(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    keys, count = pack_cells(cells), len(cells)
    table = np.full((count, len(OFFSETS)), count, np.int64)
    middle = len(OFFSETS) // 2
    rows = np.arange(count)
    table[:, middle] = rows
    for n in range(middle):  # the rest mirrors these
        found = find_rows(keys, keys + int(pack_cells(OFFSETS[n]) - pack_cells(np.zeros(3, np.int64))))
        table[:, n] = found
        here = found < count
        table[found[here], len(OFFSETS) - 1 - n] = rows[here]
    return table


class _Submanifold(torch.autograd.Function):
    """Gather and multiply in chunks. The gradient of the input is the same convolution with mirrored weights."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(x, weight, table)
        return _convolve(x, weight, table)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, weight, table = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        places, channels_in, channels_out = weight.shape
        if not ctx.needs_input_grad[0]:
            of_weight = x.new_zeros(places * channels_in, channels_out)
            for rows, gathered in _chunks(x, table):
                of_weight.addmm_(gathered.t(), gradient[rows])
            return None, of_weight.view_as(weight), None
        # The table is symmetric: gradients gathered once serve the input and, mirrored, the weights.
        mirrored = weight.flip(0).transpose(1, 2).reshape(-1, channels_in)
        of_x, of_weight = torch.empty_like(x), x.new_zeros(channels_in, places * channels_out)
        for rows, gathered in _chunks(gradient, table):
            torch.mm(gathered, mirrored, out=of_x[rows])
            of_weight.addmm_(x[rows].t(), gathered)
        return of_x, of_weight.view(channels_in, places, channels_out).flip(1).transpose(0, 1), None


def _convolve(x: torch.Tensor, weight: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
    flat = weight.reshape(-1, weight.shape[2])
    out = x.new_empty(len(table), weight.shape[2])
    for rows, gathered in _chunks(x, table):
        torch.mm(gathered, flat, out=out[rows])
    return out


def _chunks(x: torch.Tensor, table: torch.Tensor) -> Iterator[tuple[slice, torch.Tensor]]:
    """Rows, and features of their neighbours (rows, K * C)."""
    padded = torch.cat((x, x.new_zeros(1, x.shape[1])))
    for start in range(0, len(table), CHUNK_ROWS):
        part = table[start : start + CHUNK_ROWS]
        yield slice(start, start + len(part)), padded.index_select(0, part.reshape(-1)).view(len(part), -1)


class SubmanifoldConv(nn.Module):
    """3^3 convolution over occupied cells; weight (27, in, out) in the order of ``OFFSETS``."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_initial(27, channels_in, channels_out))
        self.bias = nn.Parameter(torch.zeros(channels_out))

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (N, in) of the level's cells -> (N, out)."""
        convolved: torch.Tensor = _Submanifold.apply(x, self.weight, level.neighbours)  # pyright: ignore[reportAssignmentType]
        return convolved + self.bias


class Down(nn.Module):
    """2^3 convolution of stride 2: each coarser cell sees the cells in it; weight (8, in, out)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_initial(8, channels_in, channels_out))
        self.bias = nn.Parameter(torch.zeros(channels_out))

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (N, in) of the level's cells -> (P, out) of the next coarser level's."""
        coarse = x.new_zeros(level.parents, self.weight.shape[2])
        # Each cell has one parent: eight products of what stands in the same corner, which needs no padding.
        for corner in range(8):
            here = (level.corner == corner).nonzero()[:, 0]
            coarse = coarse.index_add(0, level.parent[here], x[here] @ self.weight[corner])
        return coarse + self.bias


class Up(nn.Module):
    """Transposed 2^3 convolution back to the cells that are occupied; weight (8, in, out)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_initial(8, channels_in, channels_out) * 8**0.5)  # each cell has one parent
        self.bias = nn.Parameter(torch.zeros(channels_out))

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (P, in) of the next coarser level -> (N, out) of the level's cells."""
        count, wide = len(x), self.weight.shape[2]
        spread = x @ self.weight.permute(1, 0, 2).reshape(x.shape[1], 8 * wide)  # (P, 8 * out)
        return spread.view(count * 8, wide).index_select(0, level.parent * 8 + level.corner) + self.bias


def _initial(places: int, channels_in: int, channels_out: int) -> torch.Tensor:
    return torch.randn(places, channels_in, channels_out) * (2 / (places * channels_in)) ** 0.5
