"""Boxes of a scene in its frames: which are in view at all, which pixels show those that move, and what is in these.

Boxes that no frame sees are left out before a field is built, however many there are.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.scene.boxes import MovingBoxes, RaysInBox
from semantic_mapper.fields.scene.grid import NOTHING, OPAQUE, SceneGrid, ray_fraction
from semantic_mapper.fields.scene.panoptic import CORE, LOOSE_M, Panoptic
from semantic_mapper.fields.scene.primitives import ALONE_NS, Primitive
from semantic_mapper.geometry import invert_pose
from semantic_mapper.training.frame_rays import FrameRays
from semantic_mapper.training.grid_fit import grid_of_depth
from semantic_mapper.types import Bool, Float32, Float64, Int64, PosedFrame

PAIRS = 1 << 20  # of boxes and cameras that are looked at together
ELSEWHERE = 0.05  # of z, by which measured depth lies before a box or behind it where a pixel shows something else
LEAST_PIXELS = 50  # measured inside of a box in all frames, below which nothing is known of its inside
OPAQUE_RAW = 9.0  # raw density of a box of whose inside nothing is known
FAR_M = 1e4  # z of what does not hide anything of a box
SPREAD = 5  # voxels over which colours are averaged


def boxes_in_view(boxes: Sequence[Primitive], frames: Sequence[PosedFrame]) -> Bool:
    """Which boxes (P,) may be in the image of a frame, none of those that are for certain (what hides them is ignored).

    A box is taken as the ball round it, and an image as the cone through its corners. Boxes that move are looked at
    where they are at the time of each frame.

    Args:
        boxes: P of them.
        frames: With rigid poses, at any size.

    Raises:
        ConfigError: no box may be in any image.
    """
    balls = [_ball(box) for box in boxes]
    centre = np.array([c for c, _ in balls]).reshape(-1, 3)
    radius = np.array([r for _, r in balls])
    still = np.array([not box.moves for box in boxes], np.bool_)
    cone = np.array([_half_angle(frame) for frame in frames])
    pose = np.array([frame.T_world_camera for frame in frames]).reshape(-1, 4, 4)
    seen = np.zeros(len(boxes), np.bool_)
    at = np.array([box.T_world_box for box in boxes]).reshape(-1, 4, 4)
    world = np.einsum("pij,pj->pi", at[:, :3, :3], centre) + at[:, :3, 3]
    part = max(PAIRS // max(len(frames), 1), 1)
    for chosen in np.split(np.flatnonzero(still), range(part, int(still.sum()), part)):
        seen[chosen] = _meets(world[chosen], radius[chosen, None], pose, cone).any(1)
    for number in np.flatnonzero(~still).tolist():
        seen[number] = _moving_meets(boxes[number], centre[number], radius[number], frames, cone)
    if len(boxes) and not seen.any():
        raise nothing_in_view(world, world, pose[:, :3, 3], moving=not still.all())
    return seen


def nothing_in_view(low: Float64, high: Float64, cameras: Float64 | Float32, moving: bool = False) -> ConfigError:
    """That no box is in view of any frame, with where boxes (P, 3) and cameras (F, 3) are."""
    times = ", and the stamps of those that move the log's, in nanoseconds" if moving else ""
    return ConfigError(
        f"no box is in view of any frame: boxes lie from {_metres(low.min(0))} to {_metres(high.max(0))}, cameras from "
        f"{_metres(cameras.min(0))} to {_metres(cameras.max(0))}. Are the boxes in the log's world frame{times}?"
    )


def _ball(box: Primitive) -> tuple[Float64, float]:
    """Centre (3,) in the box's axes and radius of a ball round it and what may still be of its class."""
    low, high = -box.size / 2, box.size / 2
    if box.vertices is not None:
        low, high = box.vertices.min(0), box.vertices.max(0)
    elif box.polygon is not None:
        low, high = (np.append(f(box.polygon, axis=0), z) for f, z in ((np.min, low[2]), (np.max, high[2])))
    return (low + high) / 2, float(np.linalg.norm((high - low) / 2 + LOOSE_M))


def _half_angle(frame: PosedFrame) -> float:
    """Of the cone round the optical axis that holds the image, radians."""
    k = frame.intrinsics
    x = max(k.cx + 0.5, k.width - 0.5 - k.cx) / k.fx
    y = max(k.cy + 0.5, k.height - 0.5 - k.cy) / k.fy
    return float(np.arctan(np.hypot(x, y)))


def _meets(centre: Float64, radius: Float64, pose: Float64, cone: Float64) -> Bool:
    """Which balls (P,) meet the cones of which cameras (F,): (P, F). ``radius`` (P, 1)."""
    away = centre[:, None] - pose[None, :, :3, 3]
    z = np.einsum("pfi,fi->pf", away, pose[:, :3, 2])
    distance = np.linalg.norm(away, axis=-1)
    angle = np.arccos(np.clip(z / np.maximum(distance, 1e-9), -1, 1))
    wide = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0, 1))
    return (distance <= radius) | (angle <= cone + wide)


def _moving_meets(box: Primitive, centre: Float64, radius: float, frames: Sequence[PosedFrame], cone: Float64) -> bool:
    assert box.stamps is not None
    times = [t for t, _ in box.stamps]
    margin = max((max(times) - min(times)) // 2, ALONE_NS)
    for frame, angle in zip(frames, cone, strict=True):
        if not min(times) - margin <= frame.stamp_ns <= max(times) + margin:
            continue
        pose = box.pose_at(frame.stamp_ns)
        if pose is None:
            continue
        world = pose[:3, :3] @ centre + pose[:3, 3]
        camera = np.asarray(frame.T_world_camera, np.float64)[None]
        if _meets(world[None], np.array([[radius]]), camera, np.array([angle])).any():
            return True
    return False


def _metres(xyz: Float64 | Float32) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in xyz) + ") m"


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
    """Colours of the measured points in the grid, averaged over some voxels; grey away from them."""
    pixels = np.flatnonzero((rays.depth_m > 0) & (rays.depth_m < FAR_M))
    in_grid = grid.rays(rays.rays(pixels, 0.0))
    vertex = in_grid.points(torch.from_numpy(rays.depth_m[pixels])[:, None])[:, 0].round().long()
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
        z = (ray_fraction(samples) * samples.z).sum(1) / samples.opacity.clamp_min(1e-6)
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
