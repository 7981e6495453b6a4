"""Fit fields of one scene: stage A the geometry, from all frames; stage B what the kind adds to it.

``fitters`` names the fitter of each kind that has one of its own.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import msgspec
import numpy as np
import torch
from torch import nn

from semantic_mapper.config import GridFieldConfig, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.grid.field import GridField
from semantic_mapper.fields.grid.trunk import Trunk
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.registry import build_field, field_config
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.finetune import FinetuneConfig, FinetuneProgress
from semantic_mapper.training.frame_rays import frame_rays
from semantic_mapper.training.grid_fit import GridFit, GridFitConfig, GridFitProgress, fit_grid, psnr_of
from semantic_mapper.types import PosedFrame

TRUNK_RAYS, TRUNK_SAMPLES = 1024, 8
FEATURE_RATE, TRUNK_RATE = 2e-2, 2e-3
GRID_UNTIL = 0.6  # fraction of the time, where features are fitted to the grid afterwards

OnProgress = Callable[[FinetuneProgress], None]


class Fitter(Protocol):
    """As ``finetune``: frames without labels help with geometry, those with labels say the classes."""

    def __call__(
        self,
        frames: Sequence[PosedFrame],
        label_set: LabelSet,
        start: LearnedField | None,
        config: FinetuneConfig,
        on_progress: OnProgress | None = None,
        stopped: Callable[[], object] = bool,
        seen_stamps_ns: Iterable[int] = (),
    ) -> Checkpoint:
        """Fit to a scene."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class FittedGeometry:
    """What stage A gives: a field with a fitted grid, and how well it renders what it was not fitted to."""

    field: GridField
    fit: GridFit


def fit_geometry(
    kind: str,
    frames: Sequence[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    config: FinetuneConfig,
    on_progress: OnProgress | None = None,
    stopped: Callable[[], object] = bool,
    shape: GridFieldConfig | None = None,
) -> FittedGeometry:
    """Stage A: a field of ``kind`` (a ``GridField``) whose grid shows the frames.

    Args:
        start: Gives the kind's config, and the box unless ``config.grid`` names one; its weights are not looked at.
        config: ``seconds`` bounds the time and ``steps``, if not 0, is the number of steps.
        shape: Config of the kind in place of ``start``'s, but for the box.

    Raises:
        FrameError, ConfigError: of ``fit_grid``.
    """
    given = start.config if isinstance(start, GridField) else field_config(kind, {})
    if not isinstance(given, GridFieldConfig):
        raise ConfigError(f"a field of kind '{kind}' has no scene grid; kinds with one build on GridField")
    box = given.grid if start is not None and config.grid.box_m is None else None
    fit = fit_grid(frames, grid_settings(config), _grid_progress(on_progress), stopped, box)
    torch.manual_seed(config.seed)  # of what the kind draws
    field = build_field(kind, msgspec.structs.replace(shape or given, grid=fit.grid.config), label_set)
    assert isinstance(field, GridField)
    field.grid = fit.grid
    field.fitted_steps += fit.steps
    return FittedGeometry(field, fit)


def fit_scene(
    frames: Sequence[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    config: FinetuneConfig,
    on_progress: OnProgress | None = None,
    stopped: Callable[[], object] = bool,
    seen_stamps_ns: Iterable[int] = (),
) -> Checkpoint:
    """Fit a plain ``GridField``: geometry and colour, no classes. Arguments and errors as of ``fit_geometry``."""
    began = time.monotonic()
    until = GRID_UNTIL if isinstance(start, GridField) and start.trunk is not None else 1.0
    part = msgspec.structs.replace(config, seconds=until * config.seconds)
    progress = part_of(on_progress, 0, until)
    geometry = fit_geometry(GridField.kind, frames, label_set, start, part, progress, stopped)
    field = geometry.field
    if field.trunk is not None:
        ends = began + config.seconds if config.seconds else math.inf
        fit_trunk(
            field,
            field.trunk,
            geometry.fit,
            grid_settings(config),
            lambda: stopped() or time.monotonic() > ends,
            part_of(on_progress, until, 1.0),
        )
    return scene_checkpoint(geometry, config, time.monotonic() - began, seen_stamps_ns)


def fit_trunk(
    field: GridField,
    trunk: Trunk,
    fit: GridFit,
    config: GridFitConfig,
    stopped: Callable[[], object] = bool,
    on_progress: OnProgress | None = None,
) -> float:
    """Fit features, trunk and colour head to the frames of a grid's fit; the geometry stays.

    Returns the PSNR of the last steps' rays in dB.
    """
    rng = np.random.default_rng(config.seed)
    rays = frame_rays(fit.frames, config.width)
    networks = [p for name, p in trunk.named_parameters() if name != "features"]
    groups = [{"params": [trunk.features], "lr": FEATURE_RATE}, {"params": networks, "lr": TRUNK_RATE}]
    optimiser = torch.optim.Adam(groups, fused=True)  # without temporaries as large as the features
    errors: list[float] = []
    for step in range(config.trunk_steps):
        if stopped():
            break
        pixels = rng.integers(0, len(rays), TRUNK_RAYS)
        batch = rays.rays(pixels, config.near_m)
        with torch.no_grad():
            samples = field.march(batch, TRUNK_SAMPLES, torch.from_numpy(rng.random(len(pixels), np.float32)))
            behind = field.grid.sky_colour(batch.direction) * samples.light[:, None]
            weight = samples.weight * (samples.opacity / samples.weight.sum(1).clamp_min(1e-6))[:, None]
        gain = torch.from_numpy(fit.gains[rays.frame_of(pixels)])
        seen = gain * ((weight[..., None] * field.colour(samples)).sum(1) + behind)
        loss = nn.functional.mse_loss(seen, torch.from_numpy(rays.rgb[pixels] / np.float32(255)))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        errors.append(float(loss.detach()))
        if on_progress is not None:
            done = (step + 1) / config.trunk_steps
            on_progress(FinetuneProgress(step + 1, done, errors[-1], math.nan, math.nan, False))
    return psnr_of(float(np.mean(errors[-50:]))) if errors else float("nan")


def scene_checkpoint(
    geometry: FittedGeometry,
    config: FinetuneConfig,
    seconds: float,
    seen_stamps_ns: Iterable[int] = (),
    labelled: Sequence[PosedFrame] = (),
) -> Checkpoint:
    """The weights with their recipe; ``labelled`` are frames whose labels were used."""
    fit = geometry.fit
    recipe = {
        "kind": "scene fit",
        "width": config.width,
        "config": to_plain(config),
        "steps": fit.steps,
        "seconds": round(seconds, 1),
        "psnr": None if np.isnan(fit.psnr) else round(fit.psnr, 2),
        "train_stamps_ns": sorted({int(f.stamp_ns) for f in labelled} | {int(s) for s in seen_stamps_ns}),
    }
    return Checkpoint(geometry.field.eval(), (), recipe)


def grid_settings(config: FinetuneConfig) -> GridFitConfig:
    """How the grid is fitted within the budget of a finetuning."""
    steps = config.steps or config.grid.steps
    seconds = config.seconds
    return msgspec.structs.replace(config.grid, steps=steps, seconds=seconds, width=config.width, seed=config.seed)


def part_of(on_progress: OnProgress | None, first: float, last: float) -> OnProgress | None:
    """Progress of a part of a fit, which takes it from the fraction ``first`` to ``last``."""
    if on_progress is None:
        return None
    return lambda p: on_progress(replace(p, fraction=first + (last - first) * p.fraction))


def _grid_progress(on_progress: OnProgress | None) -> Callable[[GridFitProgress], None] | None:
    """Progress of the grid in the words of a finetuning: held-out figures come at the end only."""
    if on_progress is None:
        return None
    return lambda p: on_progress(FinetuneProgress(p.step, p.fraction, p.loss, math.nan, math.nan, False))
