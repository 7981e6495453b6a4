"""Rays through primitives: a compiled loop gives the intervals of a ray inside each closed mesh."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float64, Int32, Int64, RayBatch

MAX_INTERVALS = 32  # of a ray; those behind are dropped


class Meshes(NamedTuple):
    """Closed meshes as kernels take them: vertices (V, 3), faces (F, 3), first face of each (P + 1,), bounds (P, 3)."""

    vertices: Float64
    faces: Int64
    first: Int64
    low: Float64
    high: Float64


@parallel_kernel(chunks_per_thread=4)
def ray_intervals(
    count: int,
    meshes: Meshes,
    origin: Float64,
    direction: Float64,
    near: Float64,
    far: Float64,
    enter: Float64,
    leave: Float64,
    mesh: Int32,
    found: Int64,
    /,
) -> None:
    """Where ``count`` rays are inside which mesh."""


@dataclass(frozen=True, slots=True, eq=False)
class Intervals:
    """Where R rays are inside of primitives: at most M intervals each, by ascending ``enter``.

    Args:
        enter, leave: (R, M) float32 metres of z; infinite where there is none.
        index: (R, M) int64 position of the primitive; -1 where there is none.
        count: (R,) int64 how many there are; those beyond M are left out.
    """

    enter: torch.Tensor
    leave: torch.Tensor
    index: torch.Tensor
    count: torch.Tensor

    def inside(self, z: torch.Tensor) -> torch.Tensor:
        """Whether samples at z (R, K) are in intervals: (R, K, M) bool."""
        return (z[..., None] >= self.enter[:, None]) & (z[..., None] <= self.leave[:, None])

    def to(self, device: torch.device) -> Intervals:
        """The same on a device."""
        return Intervals(*(t.to(device) for t in (self.enter, self.leave, self.index, self.count)))


def trimmed(found: Intervals) -> Intervals:
    """Without columns that no ray needs; one at least."""
    most = max(int((found.index >= 0).sum(1).max()) if len(found.index) else 0, 1)
    return replace(found, enter=found.enter[:, :most], leave=found.leave[:, :most], index=found.index[:, :most])


class PrimitiveSet:
    """Primitives that stand still, ready for rays.

    Args:
        primitives: P of them, none of which moves.

    Raises:
        ConfigError: a mesh is open or has no volume, naming its box.
    """

    def __init__(self, primitives: Sequence[Primitive]) -> None:
        self.primitives = tuple(primitives)
        vertices: list[Float64] = []
        faces: list[Int64] = []
        for primitive in self.primitives:
            try:
                v, f = primitive.mesh()
            except ConfigError as error:
                raise ConfigError(f"box {primitive.id} ({primitive.class_name}): {error}") from error
            faces.append(f + sum(map(len, vertices)))
            vertices.append(v)
        self.meshes = Meshes(
            np.ascontiguousarray(np.concatenate(vertices or [np.zeros((0, 3))])),
            np.ascontiguousarray(np.concatenate(faces or [np.zeros((0, 3), np.int64)])),
            np.cumsum([0, *map(len, faces)], dtype=np.int64),
            np.array([v.min(0) for v in vertices]).reshape(-1, 3),
            np.array([v.max(0) for v in vertices]).reshape(-1, 3),
        )

    def __len__(self) -> int:
        return len(self.primitives)

    def intervals(self, rays: RayBatch, most: int = MAX_INTERVALS) -> Intervals:
        """Where rays (R,) are inside, from their near bound on, however far."""
        far = np.full(len(rays.near_m), np.inf)
        return self._intervals(_array(rays.origin), _array(rays.direction), _array(rays.near_m), far, most)

    def inside(self, points: Float64) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
        """Which points (N, 3) world metres are inside which primitive: (N, P) bool."""
        origin = np.ascontiguousarray(points, np.float64)
        # Out to beyond all of them, in a direction that no face of a box is likely to have.
        along = np.tile((0.8217, 0.4463, 0.3541), (len(origin), 1))
        found = self._intervals(origin, along, np.zeros(len(origin)), np.full(len(origin), np.inf), max(len(self), 1))
        result = np.zeros((len(origin), len(self)), np.bool_)
        here = (found.index >= 0) & (found.enter <= 0)
        row, column = here.nonzero(as_tuple=True)
        result[row.numpy(), found.index[row, column].numpy()] = True
        return result

    def _intervals(self, origin: Float64, direction: Float64, near: Float64, far: Float64, most: int) -> Intervals:
        count = len(origin)
        enter, leave = np.empty((count, most)), np.empty((count, most))
        mesh, found = np.empty((count, most), np.int32), np.empty(count, np.int64)
        ray_intervals(count, self.meshes, origin, direction, near, far, enter, leave, mesh, found)
        return Intervals(
            torch.from_numpy(enter).float(),
            torch.from_numpy(leave).float(),
            torch.from_numpy(mesh).long(),
            torch.from_numpy(found),
        )


def _array(tensor: torch.Tensor) -> Float64:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float64)
