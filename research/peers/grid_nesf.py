"""NeSF (Vora et al. 2022): classes of a scene from its density alone, by a 3D network that has seen other scenes.

A fitted density is resampled to n x n x n / 2 vertices. A sparse 3D U-Net gives features where something is; between
them they are trilinear, and a small network makes logits of them. Those are composited along rays as colours are.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from research.peers.unet3d import LEVELS, UNet3d
from semantic_mapper.config import AtLeastOne, Config, GridConfig
from semantic_mapper.fields.nesf import Near, cell_levels, near_cells
from semantic_mapper.fields.scene.grid import SceneGrid
from semantic_mapper.labels import LabelSet

DENSE = 0.01  # opacity of a voxel from which on there is something
MARGIN = math.sqrt(2)  # in x and y, so that the scene stays inside however it is turned
MIN_WEIGHT = 1e-3  # samples that bring less are left out


class GridNesfConfig(Config, frozen=True):
    """Shape of the network."""

    size: Annotated[int, msgspec.Meta(ge=8, le=256)] = 48  # vertices along x and y
    width: AtLeastOne = 8  # of the finest level
    features: AtLeastOne = 32
    decoder: AtLeastOne = 128


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where the network's n x n x n / 2 vertices lie: over a box with a margin, turned about its vertical axis.

    Args:
        box: Of the scene.
        size: Vertices along x and y; half as many along z, as scenes are flat.
        angle: Radians by which the scene is turned before the network sees it.
    """

    box: GridConfig
    size: int
    angle: float = 0.0

    def spacing(self) -> NDArray[np.float64]:
        """(3,) metres from vertex to vertex."""
        return self._sides() * (MARGIN, MARGIN, 1.0) / (self._shape() - 1)

    def vertices(self, xyz: torch.Tensor) -> torch.Tensor:
        """Points (..., 3) of the world in vertices of the network."""
        turned = (xyz - self._middle()) @ self._rotation().T
        return turned / torch.from_numpy(self.spacing()).to(xyz) + torch.from_numpy((self._shape() - 1) / 2).to(xyz)

    def world(self) -> torch.Tensor:
        """Points (n, n, 2) of the world, x and y, over and under which the vertices lie."""
        axes = [
            (torch.arange(self.size, dtype=torch.float32) - (self.size - 1) / 2) * float(s) for s in self.spacing()[:2]
        ]
        flat = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        return flat @ self._rotation()[:2, :2] + self._middle()[:2]

    def _shape(self) -> NDArray[np.int64]:
        return np.array((self.size, self.size, self.size // 2))

    def _sides(self) -> NDArray[np.float64]:
        return (np.array(self.box.shape) - 1) * self.box.voxel_m

    def _middle(self) -> torch.Tensor:
        return torch.from_numpy((self._sides() / 2 + self.box.origin_m).astype(np.float32))

    def _rotation(self) -> torch.Tensor:
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return torch.tensor(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class DensityCells:
    """What the network sees of a scene.

    Args:
        placement: Of the vertices.
        cells: (M, 3) int64 vertices where something is, in lexicographic order.
        rho: (M, 1) float32 opacity of a voxel there.
    """

    placement: Placement
    cells: NDArray[np.int64]
    rho: torch.Tensor

    def near(self, xyz: torch.Tensor) -> Near:
        """Trilinear weights of points (N, 3) of the world."""
        return near_cells(self.placement.vertices(xyz).numpy() + np.float32(0.5), self.cells)


def smooth_opacity(grid: SceneGrid, size: int) -> torch.Tensor:
    """Opacity (n / 2, X, Y) of a grid's voxels in the network's layers, averaged over what a vertex stands for."""
    ratio = Placement(grid.config, size).spacing() / grid.config.voxel_m
    kernel = [2 * int(r / 2) + 1 for r in ratio]
    with torch.no_grad():
        alpha = grid.alpha()[None, None]
        smooth = functional.avg_pool3d(alpha, kernel, 1, [k // 2 for k in kernel], count_include_pad=False)[0, 0]
        return functional.interpolate(smooth, size // 2, mode="linear", align_corners=True).movedim(2, 0).contiguous()


def density_cells(opacity: torch.Tensor, placement: Placement) -> DensityCells:
    """The vertices of a placement at which something is.

    Args:
        opacity: (n / 2, X, Y) at the vertices of ``placement.box`` in x and y, from ``smooth_opacity``.
    """
    box = placement.box
    place = (placement.world() - torch.tensor(box.origin_m[:2])) / box.voxel_m
    unit = place / (torch.tensor(box.shape[:2]) - 1) * 2 - 1
    layers = functional.grid_sample(opacity[None], unit.flip(-1)[None], align_corners=True)[0]  # 0 outside
    rho = layers.movedim(0, 2)  # (n, n, n / 2)
    cells = (rho > DENSE).nonzero()
    if not len(cells):
        cells = torch.full((1, 3), placement.size // 4)
    return DensityCells(placement, cells.numpy(), rho[tuple(cells.T)][:, None])


class GridNesf(nn.Module):
    """Density in, logits out; the same weights for every scene.

    Args:
        label_set: L classes.
    """

    def __init__(self, label_set: LabelSet, config: GridNesfConfig | None = None) -> None:
        super().__init__()
        self.label_set, self.config = label_set, config or GridNesfConfig()
        wide = self.config.decoder
        self.net = UNet3d(1, self.config.features, self.config.width)
        self.decoder = nn.Sequential(nn.Linear(self.config.features, wide), nn.ReLU(), nn.Linear(wide, wide), nn.ReLU())
        self.head = nn.Linear(wide, len(label_set))
        self.nothing = nn.Parameter(torch.zeros(len(label_set)))

    def features(self, seen: DensityCells) -> torch.Tensor:
        """(M, F) of the cells."""
        return self.net(seen.rho, cell_levels(seen.cells, LEVELS))

    def logits(self, features: torch.Tensor, near: Near) -> torch.Tensor:
        """Logits (N, L) at points; where no cell is, of features that are 0."""
        padded = torch.cat((features, features.new_zeros(1, features.shape[1])))
        here = functional.embedding_bag(near.rows, padded, mode="sum", per_sample_weights=near.weights)
        return self.head(self.decoder(here))

    def composite(self, logits: torch.Tensor, weight: torch.Tensor, ray: torch.Tensor, count: int) -> torch.Tensor:
        """Logits (count, L) of rays: those of samples (N, L) by their weights (N,) and rays (N,), and one learned
        vector for the light that is left."""
        total = torch.zeros(count).index_add(0, ray, weight)
        found = torch.zeros(count, logits.shape[1]).index_add(0, ray, logits * weight[:, None])
        return found + (1 - total)[:, None] * self.nothing
