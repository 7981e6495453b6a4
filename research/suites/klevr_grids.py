"""Densities of KLEVR scenes, fitted to their images alone and kept in a folder: a scene is fitted once."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from research.scenes.klevr import BOX_HIGH_M, BOX_LOW_M, Variant, klevr_camera, klevr_views
from research.scenes.suite import KLEVR_SUITE
from research.suites.kept import NPZ_ERRORS, warn_unreadable
from semantic_mapper.config import AtLeastOne, AtLeastTwo, Config, GridConfig, NotNegative, to_plain
from semantic_mapper.files import write_bytes
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig
from semantic_mapper.training.grid_fit import OPACITY, fit_grid, held_out_psnr

_log = get_logger(__name__)

VERSION = 1  # raised by a change of the fit: older files are left alone and made again
NEAR_M = 1.0  # no camera comes nearer to a solid


class KlevrGridConfig(Config, frozen=True):
    """How the density of a scene is fitted."""

    views: AtLeastTwo = 70  # the first of the scene
    checked_views: NotNegative = 4  # the next after ``checked_from``, for the PSNR
    checked_from: NotNegative = 70
    width: Annotated[int, msgspec.Meta(ge=16)] = 72
    variant: Variant = "upright"
    long_side: Annotated[int, msgspec.Meta(ge=8)] = 64
    steps: AtLeastOne = 600


@dataclass(frozen=True, slots=True, eq=False)
class SceneDensity:
    """A fitted scene.

    Args:
        grid: Where its vertices are.
        raw: (X, Y, Z) float16 raw density, as in ``SceneGrid``.
        psnr: Of the checked views in dB; NaN without.
    """

    grid: GridConfig
    raw: NDArray[np.float16]
    psnr: float


def grid_digest(config: KlevrGridConfig, scene: int) -> str:
    """What tells files apart that were made in another way: 16 hex digits."""
    plain = to_plain(config) | {"scene": scene, "suite_version": KLEVR_SUITE.version, "version": VERSION}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def scene_density(config: KlevrGridConfig, scene: int, folder: Path) -> SceneDensity:
    """The density of a scene: read from ``folder``, or fitted and kept there. Both give the same bits.

    Depth and labels are not looked at.
    """
    path = folder / f"klevr-{scene}-{grid_digest(config, scene)}.npz"
    if (found := _read(path)) is not None:
        return found
    grid = GridFitConfig(
        long_side=config.long_side,
        box_m=(*BOX_LOW_M, *BOX_HIGH_M),
        near_m=NEAR_M,
        opacity=OPACITY,
        exposure=False,
        held_out=0,
    )
    settings = FinetuneConfig(seconds=0.0, steps=config.steps, width=config.width, seed=scene, grid=grid)
    numbers = [*range(config.views), *range(config.checked_from, config.checked_from + config.checked_views)]
    views = klevr_views(scene, numbers, klevr_camera(config.width), variant=config.variant)
    frames = [replace(view.frame, depth_m=None, label=None) for view in views]
    fit = fit_grid(frames[: config.views], settings)
    psnr, _ = held_out_psnr(fit.grid, frames[config.views :], settings)
    made = SceneDensity(fit.grid.config, fit.grid.values[..., 0].numpy().astype(np.float16), psnr)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        raw=made.raw,
        origin_m=np.array(made.grid.origin_m),
        voxel_m=np.array(made.grid.voxel_m),
        psnr=np.array(psnr),
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(path, buffer.getvalue())
    return made


def scene_densities(config: KlevrGridConfig, scenes: Iterable[int], folder: Path) -> Iterator[SceneDensity]:
    """Those of many scenes, in their order; what was fitted is kept if the run ends early."""
    for scene in scenes:
        found = scene_density(config, scene, folder)
        _log.info("scene_density", scene=scene, psnr=round(found.psnr, 1))
        yield found


def _read(path: Path) -> SceneDensity | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            raw, origin = file["raw"], [float(x) for x in file["origin_m"]]
            voxel, psnr = float(file["voxel_m"]), float(file["psnr"])
    except NPZ_ERRORS as error:
        warn_unreadable(path, error)
        return None
    x, y, z = raw.shape
    grid = GridConfig(origin_m=(origin[0], origin[1], origin[2]), voxel_m=voxel, shape=(x, y, z))
    return SceneDensity(grid, raw, psnr)
