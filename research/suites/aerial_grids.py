"""Grids of AERIAL towns, fitted to their training views' colours alone and kept in a folder: a town is fitted once."""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import torch

from research.scenes.aerial.views import cached_town
from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import (
    DAY,
    AerialConfig,
    Episode,
    scored_views,
    thin,
    thinned,
    training_frames,
)
from research.suites.kept import NPZ_ERRORS, warn_unreadable
from semantic_mapper.config import GridConfig, to_plain
from semantic_mapper.fields.scene.grid import SceneGrid
from semantic_mapper.files import write_bytes
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig
from semantic_mapper.training.grid_fit import fit_grid, held_out_psnr, render_frame
from semantic_mapper.training.views import frame_rays
from semantic_mapper.types import Float32, PosedFrame

_log = get_logger(__name__)

VERSION = 1  # raised by a change of the fit: older files are left alone and made again
FIT_NEAR_M = 8.0  # no view of the flight comes nearer to anything
NEAR_M = 1.0  # nor one of the low ring

_MARGIN_M, _LOW_M, _HIGH_M = 15.0, -3.0, 23.0  # of the box round the town


@dataclass(frozen=True, slots=True, eq=False)
class TownGrid:
    """A fitted town.

    Args:
        grid: Density and colour.
        psnr: Of the test views in dB.
        depth_error: Median of |z - true z| / true z over the pixels of the test views that have an answer.
        depth_error_m: Median of |z - true z| there, metres.
        known: Fraction of the pixels with an answer.
        seconds: CPU time of the fit.
    """

    grid: SceneGrid
    psnr: float
    depth_error: float
    depth_error_m: float
    known: float
    seconds: float


def grid_settings(config: AerialConfig, town: int) -> FinetuneConfig:
    """How the grid of a town is fitted."""
    plan = cached_town(town).plan
    x, y = plan.xs[-1] + _MARGIN_M, plan.ys[-1] + _MARGIN_M
    grid = GridFitConfig(
        voxel_m=config.voxel_m,
        box_m=(-x, -y, _LOW_M, x, y, _HIGH_M),
        near_m=FIT_NEAR_M,
        opacity=0.0,
        exposure=False,
        held_out=0,
    )
    return FinetuneConfig(seconds=0.0, steps=config.grid_steps, width=config.width, seed=config.seed, grid=grid)


def grid_digest(config: AerialConfig, town: int) -> str:
    """What tells files apart that were made in another way: 16 hex digits."""
    plain = to_plain(grid_settings(config, town)) | {"town": town, "views": config.train_views}
    plain |= {"suite_version": AERIAL_SUITE.version, "version": VERSION}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def town_grid(config: AerialConfig, town: int, folder: Path) -> TownGrid:
    """The grid of a town: read from ``folder``, or fitted and kept there. Both give the same bits.

    Labels are not looked at; exact depth only tells how far off the grid's is.
    """
    path = folder / f"aerial-{town}-{grid_digest(config, town)}.npz"
    if (found := _read(path)) is not None:
        return found
    episode, settings = Episode(town, config.seed), grid_settings(config, town)
    frames = training_frames(config, episode)
    began = time.process_time()
    fit = fit_grid(frames, settings)
    seconds = time.process_time() - began
    grid = _rounded(fit.grid)
    views = scored_views(config, episode, DAY)
    few = [thinned(v.frame, config.score_every) for v in views]
    at_few = msgspec.structs.replace(settings, width=few[0].intrinsics.width)
    psnr, _ = held_out_psnr(grid, few, at_few)
    depths = grid_depths(grid, few)
    exact = [thin(v.rendered.exact_depth_m, config.score_every) for v in views]
    pairs = [(d[d > 0], true[d > 0]) for d, true in zip(depths, exact, strict=True)]
    off = np.concatenate([np.abs(z - true) for z, true in pairs])
    true = np.concatenate([t for _, t in pairs])
    known = off.size / sum(d.size for d in depths)
    made = TownGrid(grid, psnr, float(np.median(off / true)), float(np.median(off)), known, seconds)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        values=grid.values.numpy().astype(np.float16),
        sky=grid.sky.numpy(),
        origin_m=np.array(grid.config.origin_m),
        figures=np.array((grid.config.voxel_m, psnr, made.depth_error, made.depth_error_m, known, seconds)),
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(path, buffer.getvalue())
    _log.info("town_grid", town=town, psnr=round(psnr, 2), depth_error_m=round(made.depth_error_m, 2), s=round(seconds))
    return made


def grid_depths(grid: SceneGrid, frames: Sequence[PosedFrame]) -> list[Float32]:
    """z (H, W) in metres of frames as the grid shows them, 0 where it stops less than half of the light."""
    rays = frame_rays(frames, frames[0].intrinsics.width)
    return [render_frame(grid, rays, k, NEAR_M)[1] for k in range(len(frames))]


def _rounded(grid: SceneGrid) -> SceneGrid:
    """As it comes back from a file."""
    with torch.no_grad():
        grid.values.copy_(grid.values.half().float())
    grid.update_occupied()
    return grid


def _read(path: Path) -> TownGrid | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            values, sky, origin = file["values"], file["sky"], [float(x) for x in file["origin_m"]]
            voxel, *figures = (float(x) for x in file["figures"])
    except NPZ_ERRORS as error:
        warn_unreadable(path, error)
        return None
    x, y, z, _ = values.shape
    grid = SceneGrid(GridConfig(origin_m=(origin[0], origin[1], origin[2]), voxel_m=voxel, shape=(x, y, z)))
    with torch.no_grad():
        grid.values.copy_(torch.from_numpy(values.astype(np.float32)))
        grid.sky.copy_(torch.from_numpy(sky))
    grid.update_occupied()
    psnr, depth_error, depth_error_m, known, seconds = figures
    return TownGrid(grid, psnr, depth_error, depth_error_m, known, seconds)
