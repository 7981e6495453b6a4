"""Boxes that move, in a fit: which pixels may show them, and small grids of what is in them."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.fields.grid.field import OPAQUE
from semantic_mapper.fields.grid.scene_grid import NOTHING, SceneGrid
from semantic_mapper.fields.moving_boxes import MovingBoxes, RaysInBox
from semantic_mapper.fields.panoptic import CORE, Panoptic, ray_share
from semantic_mapper.geometry import invert_pose
from semantic_mapper.training.frame_rays import FrameRays
from semantic_mapper.training.grid_depth import grid_of_depth
from semantic_mapper.types import Bool, Float32, Int64, PosedFrame

ELSEWHERE = 0.05  # of z, by which measured depth lies before a box or behind it where a pixel shows something else
LEAST_PIXELS = 50  # measured inside of a box in all frames, below which nothing is known of its inside
OPAQUE_RAW = 9.0  # raw density of a box of whose inside nothing is known
FAR_M = 1e4  # z of what does not hide anything of a box
SPREAD = 5  # voxels over which colours are averaged


def shown_boxes(boxes: MovingBoxes, frames: Sequence[PosedFrame], rays: FrameRays) -> tuple[Bool, Int64]:
    """Which pixels (P,) of frames may show a box that moves, and how many may show each box (M,)."""
    shown, count = np.zeros(len(rays), np.bool_), np.zeros(len(boxes), np.int64)
    for number, frame in enumerate(frames):
        for met, pixels in _met(boxes, frame, rays, number):
            depth = torch.from_numpy(rays.depth_m[pixels])
            enter, leave = _ends(met)
            known = depth > 0
            elsewhere = known & ((depth < (1 - ELSEWHERE) * enter) | (depth > (1 + ELSEWHERE) * leave))
            shown[pixels[~elsewhere.numpy()]] = True
            count[met.number] += int((~elsewhere).sum())
    return shown, count


def fill_boxes(field: Panoptic, frames: Sequence[PosedFrame], rays: FrameRays, gains: Float32, near_m: float) -> None:
    """Fill the grids of the boxes that move from depth images and colours; the scene's own grid is fitted.

    What the scene itself has at a measured depth, such as the road under a car, is not of the box. Where no frame
    measures the inside of a box, its core is full.

    Args:
        field: Its boxes that move are filled.
        frames: F of them.
        rays: Of the frames.
        gains: (F, 3) exposure of the frames.
        near_m: From which on rays look.
    """
    boxes = field.moving
    depths = [np.zeros_like(rays.depth_m) for _ in boxes.primitives]
    measured = np.zeros(len(boxes), np.int64)
    for number, frame in enumerate(frames):
        for met, pixels in _met(boxes, frame, rays, number):
            depth = rays.depth_m[pixels].copy()
            surface = _scene_depth(field, rays, pixels, near_m)
            depth[(depth > 0) & (surface > 0) & (depth > (1 - ELSEWHERE) * surface)] = FAR_M
            depths[met.number][pixels] = depth
            measured[met.number] += int(met.found.inside(torch.from_numpy(depth)[:, None]).any(-1).sum())
    poses = rays.T_world_camera.astype(np.float64)
    for box, depth in enumerate(depths):
        T_box_camera = poses.copy()
        for number, frame in enumerate(frames):
            T_world_box = boxes.primitives[box].pose_at(frame.stamp_ns)
            if T_world_box is not None:
                T_box_camera[number] = invert_pose(T_world_box) @ poses[number]
        own = replace(rays, T_world_camera=T_box_camera.astype(np.float32), depth_m=depth)
        grid = boxes.grid(box)
        if measured[box] < LEAST_PIXELS:
            _fill_core(grid)
            continue
        filled = grid_of_depth(own, grid.config, NOTHING)
        grid.load_state_dict(filled.state_dict())
        _paint(grid, own, gains)


def _fill_core(grid: SceneGrid) -> None:
    """Make the core of a box opaque, with round edges, as things have; grey."""
    axes = torch.meshgrid(*(torch.linspace(-1, 1, n) for n in grid.config.shape), indexing="ij")
    inside = torch.stack(axes).pow(4).sum(0) <= CORE**4
    with torch.no_grad():
        grid.values[..., 0] = torch.where(inside, OPAQUE_RAW, NOTHING)
    grid.update_occupied()


def _paint(grid: SceneGrid, rays: FrameRays, gains: Float32) -> None:
    """Colours of the measured points in the grid, averaged over some voxels; grey where there are none."""
    pixels = np.flatnonzero((rays.depth_m > 0) & (rays.depth_m < FAR_M))
    placed = grid.rays(rays.rays(pixels, 0.0))
    vertex = placed.points(torch.from_numpy(rays.depth_m[pixels])[:, None])[:, 0].round().long()
    inside = ((vertex >= 0) & (vertex < torch.tensor(grid.config.shape))).all(1)
    colour = torch.from_numpy(rays.rgb[pixels] / np.float32(255) / gains[rays.frame_of(pixels)])
    found = torch.zeros(*grid.config.shape, 4)
    found.index_put_(tuple(vertex[inside].T), functional.pad(colour[inside], (0, 1), value=1.0), accumulate=True)
    mean = functional.avg_pool3d(found.permute(3, 0, 1, 2), SPREAD, 1, SPREAD // 2)
    known = mean[3] > 0
    painted = torch.logit((mean[:3] / mean[3].clamp_min(1e-9)).clamp(0.01, 0.99)).permute(1, 2, 3, 0)
    with torch.no_grad():
        grid.values[..., 1:] = torch.where(known[..., None], painted, torch.zeros(()))


def _scene_depth(field: Panoptic, rays: FrameRays, pixels: Int64, near_m: float) -> Float32:
    """z (R,) of the scene that stands still at pixels, 0 where nothing is."""
    with torch.no_grad():
        samples = field.march(rays.rays(pixels, near_m))
        z = (ray_share(samples) * samples.z).sum(1) / samples.opacity.clamp_min(1e-6)
    return torch.where(samples.opacity > OPAQUE, z, 0.0).numpy()


def _ends(met: RaysInBox) -> tuple[torch.Tensor, torch.Tensor]:
    """z (N,) of the first entry and the last exit."""
    there = met.found.index >= 0
    return met.found.enter.amin(1), met.found.leave.masked_fill(~there, -torch.inf).amax(1)


def _met(boxes: MovingBoxes, frame: PosedFrame, rays: FrameRays, number: int) -> list[tuple[RaysInBox, Int64]]:
    """The boxes that pixels of a frame meet, and which pixels."""
    pixels = rays.pixels_of(number)
    batch = replace(rays.rays(pixels, 0.0), stamp_ns=frame.stamp_ns)
    return [(met, pixels[met.ray.numpy()]) for met in boxes.met(batch)]
