"""Boxes on rays: a compiled loop gives the intervals of a ray inside each closed mesh.

Boxes that move each have a small scene grid in their own axes, composited with the scene that stands still.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import nn

from semantic_mapper.config import GridConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.scene.grid import RaySamples, SceneGrid, grid_box, ray_fraction
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float64, Int32, Int64, RayBatch

MAX_INTERVALS = 32  # of a ray; those behind are dropped
FINER = 0.5  # voxels of a box, as a fraction of the scene's
MOST_VERTICES = 100_000  # of a box, about; a larger one has larger voxels


class Meshes(NamedTuple):
    """P closed meshes as kernels take them."""

    vertices: Float64  # (V, 3)
    faces: Int64  # (F, 3)
    first: Int64  # (P + 1,) first face of each
    low: Float64  # (P, 3) bounds
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
    """Where R rays are inside of primitives: at most M intervals each, by ascending ``enter``."""

    enter: torch.Tensor  # (R, M) float32 metres of z; infinite after the last interval
    leave: torch.Tensor
    index: torch.Tensor  # (R, M) int64 position of the primitive; -1 after the last
    count: torch.Tensor  # (R,) int64 how many there are; those beyond M are left out

    def inside(self, z: torch.Tensor) -> torch.Tensor:
        """Whether samples at z (R, K) are in intervals: (R, K, M) bool."""
        return (z[..., None] >= self.enter[:, None]) & (z[..., None] <= self.leave[:, None])


def trimmed(found: Intervals) -> Intervals:
    """Without columns that no ray needs; one at least."""
    most = max(int((found.index >= 0).sum(1).max()) if len(found.index) else 0, 1)
    return replace(found, enter=found.enter[:, :most], leave=found.leave[:, :most], index=found.index[:, :most])


class PrimitiveSet:
    """P primitives that stand still, ready for rays.
    Raises ConfigError: a mesh is open or has no volume, naming its box."""

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

    def intervals(self, rays: RayBatch) -> Intervals:
        """Where rays (R,) are inside, from their near bound on, however far."""
        origin, direction, near = (
            np.ascontiguousarray(t.detach().cpu().numpy(), np.float64)
            for t in (rays.origin, rays.direction, rays.near_m)
        )
        return self._intervals(origin, direction, near, MAX_INTERVALS)

    def inside(self, points: Float64) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
        """Which points (N, 3) world metres are inside which primitive: (N, P) bool."""
        origin = np.ascontiguousarray(points, np.float64)
        # Out to beyond all of them, in a direction that no face of a box is likely to have.
        along = np.tile((0.8217, 0.4463, 0.3541), (len(origin), 1))
        found = self._intervals(origin, along, np.zeros(len(origin)), max(len(self), 1))
        result = np.zeros((len(origin), len(self)), np.bool_)
        here = (found.index >= 0) & (found.enter <= 0)
        row, column = here.nonzero(as_tuple=True)
        result[row.numpy(), found.index[row, column].numpy()] = True
        return result

    def _intervals(self, origin: Float64, direction: Float64, near: Float64, most: int) -> Intervals:
        count, far = len(origin), np.full(len(origin), np.inf)
        enter, leave = np.empty((count, most)), np.empty((count, most))
        mesh, found = np.empty((count, most), np.int32), np.empty(count, np.int64)
        ray_intervals(count, self.meshes, origin, direction, near, far, enter, leave, mesh, found)
        return Intervals(
            torch.from_numpy(enter).float(),
            torch.from_numpy(leave).float(),
            torch.from_numpy(mesh).long(),
            torch.from_numpy(found),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RaysInBox:
    """Those of R rays that meet a box at its place at their time."""

    number: int  # of the box
    ray: torch.Tensor  # (N,) int64 which rays
    rays: RayBatch  # (N,) in the box's axes; z is that of the camera, as in the world
    found: Intervals  # where they are inside


class MovingBoxes(nn.Module):
    """M boxes that move, with stamps. Their grids, finer than the scene's, are empty until somebody fills them.
    Raises ConfigError: a mesh is open or has no volume, naming its box."""

    def __init__(self, primitives: Sequence[Primitive], voxel_m: float) -> None:
        super().__init__()
        self.primitives = tuple(primitives)
        self.shapes = [PrimitiveSet([replace(p, T_world_box=np.eye(4))]) for p in self.primitives]
        self.grids = nn.ModuleList(SceneGrid(_grid(shape, voxel_m)) for shape in self.shapes)
        for grid in self.grids:
            cast("SceneGrid", grid).occupied.zero_()  # values are not written, so take no memory

    def __len__(self) -> int:
        return len(self.primitives)

    def grid(self, number: int) -> SceneGrid:
        """The grid of a box."""
        return cast("SceneGrid", self.grids[number])

    def met(self, rays: RayBatch) -> Iterator[RaysInBox]:
        """The boxes that rays of one time meet; none without a time."""
        for number, box in enumerate(self.primitives):
            pose = None if rays.stamp_ns is None else box.pose_at(rays.stamp_ns)
            if pose is None:
                continue
            own = _in_axes_of(pose, rays)
            found = self.shapes[number].intervals(own)
            ray = (found.count > 0).nonzero()[:, 0]
            if len(ray):
                some = trimmed(Intervals(found.enter[ray], found.leave[ray], found.index[ray], found.count[ray]))
                device = rays.origin.device
                yield RaysInBox(number, ray.to(device), _some(own, ray.to(device)), to_device(some, device))

    def composite(self, samples: RaySamples, kept: int) -> RaySamples:
        """Samples with those of the boxes at the rays' time among them, in order, each dimmed by what is before it."""
        for met in self.met(samples.rays):
            grid = self.grid(met.number)
            marched = grid.march(met.rays, kept)
            weight = marched.weight * met.found.inside(marched.z).any(-1)
            samples = _merged(samples, met, marched.z, weight)
        return samples

    def colour(self, samples: RaySamples, colour: torch.Tensor) -> torch.Tensor:
        """Colours (R, K, 3) in [0, 1]: those of boxes where samples are theirs, else as given."""
        if samples.mover is None or samples.rays.stamp_ns is None:
            return colour
        for number, box in enumerate(self.primitives):
            here = samples.mover == number
            pose = box.pose_at(samples.rays.stamp_ns)
            if pose is None or not here.any():
                continue
            rays, grid = _in_axes_of(pose, samples.rays), self.grid(number)
            colour = torch.where(here[..., None], grid.colour(grid.points(rays, samples.z)), colour)
        return colour

    def holding(self, rays: RayBatch, z: torch.Tensor) -> torch.Tensor:
        """Number (R,) of the box that holds the point at z (R,) of each ray, -1 = none."""
        number = torch.full_like(z, -1, dtype=torch.long)
        for met in self.met(rays):
            inside = met.found.inside(z[met.ray][:, None]).any(-1)[:, 0]
            number[met.ray[inside]] = met.number
        return number


def _grid(shape: PrimitiveSet, voxel_m: float) -> GridConfig:
    low, high = shape.meshes.low[0], shape.meshes.high[0]
    least = float(np.prod(high - low) / MOST_VERTICES) ** (1 / 3)
    return grid_box(tuple(low.tolist()), tuple(high.tolist()), 2, max(FINER * voxel_m, least))


def _in_axes_of(pose: Float64, rays: RayBatch) -> RayBatch:
    T = torch.from_numpy(pose).to(rays.origin)
    origin, direction = (rays.origin - T[:3, 3]) @ T[:3, :3], rays.direction @ T[:3, :3]
    return replace(rays, origin=origin, direction=direction, far_m=torch.full_like(rays.far_m, math.inf))


def _some(rays: RayBatch, ray: torch.Tensor) -> RayBatch:
    parts = (rays.origin, rays.direction, rays.near_m, rays.far_m, rays.prior_depth_m)
    return RayBatch(*(p[ray] for p in parts), stamp_ns=rays.stamp_ns)


def _merged(samples: RaySamples, met: RaysInBox, z: torch.Tensor, weight: torch.Tensor) -> RaySamples:
    """Samples (R, K) and those of a box (N, J) on N of the rays as (R, K + J)."""
    ray = met.ray
    there = replace(samples, z=samples.z[ray], weight=samples.weight[ray], light=samples.light[ray])
    behind = z[:, None] > there.z[..., None]  # N K J
    fraction = ray_fraction(there)
    of_box = weight * (1 - (fraction[..., None] * behind).sum(1)).clamp_min(0)
    of_scene = there.weight * (1 - (weight[:, None] * ~behind).sum(2)).clamp_min(0)
    count, more = len(samples.z), z.shape[1]
    blank = z.new_zeros(count, more)
    mover = samples.mover
    if mover is None:
        mover = torch.full_like(samples.z, -1, dtype=torch.long)
    merged = RaySamples(
        samples.rays,
        torch.cat((samples.points, blank[..., None].expand(-1, -1, 3)), 1),
        torch.cat((samples.z, blank.index_put((ray,), z)), 1),
        torch.cat((samples.weight.index_put((ray,), of_scene), blank.index_put((ray,), of_box)), 1),
        samples.light.index_put((ray,), there.light * (1 - weight.sum(1)).clamp_min(0)),
        torch.cat((mover, torch.full_like(blank, met.number, dtype=torch.long)), 1),
    )
    return merged.at(merged.z.argsort(1))
