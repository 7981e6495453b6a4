"""Arms of AERIAL that stand on a town's fitted grid: labels carried by its depth, and Semantic-NeRF on it."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import (
    AerialConfig,
    Arm,
    Episode,
    Fit,
    Predict,
    labelled_frames,
    scored,
    thinned,
    training_frames,
)
from research.suites.aerial_grids import FIT_NEAR_M, NEAR_M, TownGrid, grid_depths, town_grid
from semantic_mapper.fields.scene.grid import SceneGrid
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.baselines import WarpBaseline
from semantic_mapper.training.fit import held_out_blocks
from semantic_mapper.training.views import FrameRays, frame_rays
from semantic_mapper.types import PosedFrame, UInt8

_log = get_logger(__name__)

_RAYS = 1024  # of labelled views a step, and as many of all views
_FIRST_RATE, _LAST_RATE = 0.1, 0.01  # of logits
_GRID_RATE = 0.01  # of density and colour
_SURFACE = 0.02  # opacity of a voxel from which on it has logits, and those next to it
_AT_ONCE = 8192  # rays of a picture
_LOOKS, _LOOK_RAYS = 5, 4096
HELD_OUT_FRACTION = 0.125  # of the labelled pixels, in blocks


def field_arms(folder: Path) -> dict[str, Arm]:
    """``field_fits`` as arms."""
    return {name: scored(fit) for name, fit in field_fits(folder).items()}


def field_fits(folder: Path) -> dict[str, Fit]:
    """Fits by name; grids are kept in ``folder``."""

    def warp(config: AerialConfig, episode: Episode) -> Predict:
        grid = town_grid(config, episode.town, folder).grid
        frames = labelled_frames(config, episode)
        depths = grid_depths(grid, frames)
        carried = WarpBaseline(
            AERIAL_SUITE.label_set, [replace(f, depth_m=d) for f, d in zip(frames, depths, strict=True)]
        )

        def predict(frame: PosedFrame, every: int) -> UInt8:
            few = thinned(frame, every)
            return carried.predict(replace(few, depth_m=grid_depths(grid, [few])[0]))

        return predict

    def semantic_nerf(config: AerialConfig, episode: Episode) -> Predict:
        field = fit_logits(config, episode, town_grid(config, episode.town, folder))
        return lambda frame, every: field.predict(thinned(frame, every))

    return {"warp": warp, "semantic-nerf": semantic_nerf}


class GridLogits:
    """Logits at the vertices of a grid that lie near its surface; trilinear, and composited along rays as colours are.

    Args:
        grid: Of the town; its density and colour are trained, too.
    """

    def __init__(self, grid: SceneGrid) -> None:
        self.grid, self.label_set = grid, AERIAL_SUITE.label_set
        near = functional.max_pool3d((grid.alpha() > _SURFACE).float()[None, None], 5, 1, 2)[0, 0] > 0
        self.row = torch.where(near.reshape(-1), near.reshape(-1).long().cumsum(0), 0)  # row 0 is that of all others
        self.table = torch.zeros(int(near.sum()) + 1, len(self.label_set), requires_grad=True)

    def logits(self, rays: FrameRays, pixels: NDArray[np.int64], near_m: float) -> torch.Tensor:
        """(R, L) of pixels; differentiable by logits and density."""
        march = self.grid.march(rays.rays(pixels, near_m))
        kept = march.weight > 1e-3
        ray, _ = kept.nonzero(as_tuple=True)
        here = self._at(march.points[kept])
        total = torch.zeros(len(pixels), here.shape[1])
        return total.index_add(0, ray, here * march.weight[kept][:, None])

    def predict(self, frame: PosedFrame) -> UInt8:
        """Ids (H, W) of a frame's pixels; only its camera is looked at. Unknown where the grid stops no light."""
        rays = frame_rays([frame], frame.intrinsics.width)
        found: list[NDArray[np.int64]] = []
        with torch.inference_mode():
            for first in range(0, len(rays), _AT_ONCE):
                logits = self.logits(rays, np.arange(first, min(first + _AT_ONCE, len(rays))), NEAR_M)
                found.append(torch.where(logits.abs().sum(1) > 0, logits.argmax(1), -1).numpy())
        return self.label_set.to_ids(np.concatenate(found)).reshape(rays.image_size(0))

    def _at(self, points: torch.Tensor) -> torch.Tensor:
        """(N, L) at points (N, 3) in voxels."""
        shape = self.grid.config.shape
        low = points.detach().floor()
        part, total = points - low, torch.zeros(len(points), self.table.shape[1])
        for corner in range(8):
            offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
            x, y, z = ((low.long() + offset).clamp_min(0).minimum(torch.tensor(shape) - 1)).T
            weight = torch.where(offset.bool(), part, 1 - part).prod(1)
            total = total + self.table[self.row[(x * shape[1] + y) * shape[2] + z]] * weight[:, None]
        return total


def fit_logits(config: AerialConfig, episode: Episode, start: TownGrid) -> GridLogits:
    """Semantic-NeRF on a grid: classes of the labelled views and colours of all views train logits, density and colour
    jointly, from the town's fitted grid on. One block in eight of the labelled views chooses among five states."""
    grid = SceneGrid(start.grid.config)
    grid.load_state_dict(start.grid.state_dict())
    grid.values.requires_grad_(True)
    field, label_set = GridLogits(grid), AERIAL_SUITE.label_set
    labelled, every = labelled_frames(config, episode), training_frames(config, episode)
    channel = np.concatenate([label_set.to_channels(f.label).ravel() for f in labelled if f.label is not None])
    held_out = _held_out(config, labelled) & (channel >= 0)
    known, looked_at = np.flatnonzero((channel >= 0) & ~held_out), np.flatnonzero(held_out)
    of_labels, of_all = frame_rays(labelled, config.width), frame_rays(every, config.width)
    rng = np.random.default_rng((config.seed, episode.number, 5))
    looked_at = rng.permutation(looked_at)[:_LOOK_RAYS]
    best = math.inf, field.table.detach().clone(), grid.values.detach().clone()
    logits_adam = torch.optim.Adam([field.table], _FIRST_RATE)
    grid_adam = torch.optim.Adam([grid.values], _GRID_RATE)
    every_look = max(config.nerf_steps // _LOOKS, 1)
    for step in range(config.nerf_steps):
        for group in logits_adam.param_groups:
            group["lr"] = _FIRST_RATE * (_LAST_RATE / _FIRST_RATE) ** (step / config.nerf_steps)
        pick = known[rng.integers(len(known), size=_RAYS)]
        entropy = functional.cross_entropy(field.logits(of_labels, pick, FIT_NEAR_M), torch.from_numpy(channel[pick]))
        colour = _colour_loss(grid, of_all, rng.integers(len(of_all), size=_RAYS))
        logits_adam.zero_grad()
        grid_adam.zero_grad()
        (entropy + colour).backward()
        logits_adam.step()
        grid_adam.step()
        if (step + 1) % every_look == 0:
            loss = _look(field, of_labels, looked_at, channel)
            _log.info("semantic_nerf", step=step + 1, held_out=round(loss, 4))
            if loss < best[0]:
                best = loss, field.table.detach().clone(), grid.values.detach().clone()
    grid.values.requires_grad_(False)
    with torch.no_grad():
        field.table.copy_(best[1])
        grid.values.copy_(best[2])
    grid.update_occupied()
    return field


def _held_out(config: AerialConfig, frames: list[PosedFrame]) -> NDArray[np.bool_]:
    """The pixels (F H W,) of labelled frames that IRT holds out, too."""
    generator = torch.Generator().manual_seed(config.seed)
    height, width = frames[0].rgb.shape[:2]
    masks = [held_out_blocks(height, width, HELD_OUT_FRACTION, generator).flatten() for _ in frames]
    return torch.cat(masks).numpy()


def _look(field: GridLogits, rays: FrameRays, pixels: NDArray[np.int64], channel: NDArray[np.int64]) -> float:
    """Cross-entropy at pixels that nothing was learned from."""
    with torch.no_grad():
        logits = torch.cat([field.logits(rays, part, FIT_NEAR_M) for part in np.array_split(pixels, 4)])
        return float(functional.cross_entropy(logits, torch.from_numpy(channel[pixels])))


def _colour_loss(grid: SceneGrid, rays: FrameRays, pixels: NDArray[np.int64]) -> torch.Tensor:
    batch = rays.rays(pixels, FIT_NEAR_M)
    march = grid.march(batch)
    with torch.no_grad():
        sky = grid.sky_colour(batch.direction)
    seen = (march.weight[..., None] * grid.colour(march.points)).sum(1) + march.light[:, None] * sky
    return functional.mse_loss(seen, torch.from_numpy(rays.rgb[pixels] / np.float32(255)))
