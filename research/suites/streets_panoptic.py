"""Arms of STREETS that fit a Panoptic NeRF to a street, whole or without one of its parts, or from labels alone.

Fits are kept in a folder, so that what is only rendered in another way needs no fit of its own.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from research.peers.uniform_panoptic import UniformPanoptic
from research.scenes.suite import STREETS_SUITE
from research.suites.scene_runs import ViewScores
from research.suites.streets import (
    Answer,
    Arm,
    Drive,
    StreetsConfig,
    drive,
    primitive,
    score_street,
    streets_digest,
)
from semantic_mapper.config import PanopticConfig, to_plain
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.scene.grid import ray_fraction
from semantic_mapper.fields.scene.panoptic import Panoptic, box_config
from semantic_mapper.log_events import get_logger
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig, PanopticFitConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.types import PosedFrame

_log = get_logger(__name__)

NEAR_M = 0.5
VERSION = 2  # raised by a change of the fit: older files are left alone and made again

_BEHIND_M, _AHEAD_M, _ASIDE_M, _LOW_M, _HIGH_M = 2.0, 60.0, 20.0, -0.6, 11.0  # of the grid's box, round the cameras
_AT_ONCE = 4096  # rays of a picture

STILL = "panoptic-still"  # boxes that move are left out, as if nothing moved; where cars drive
ALLOWED = "panoptic-allowed"  # the fit of "panoptic"; only classes that boxes allow are rendered
NO_DEPTH = "panoptic-no-depth"  # no frame has measured depth
UNIFORM = "panoptic-uniform"  # samples evenly along rays
GRID_LABELS = "grid-labels"  # no boxes: the predicted labels alone teach, as in Semantic-NeRF

# Arms, and what each leaves out of the fit.
LEFT_OUT: dict[str, dict[str, Any]] = {
    "panoptic": {},
    STILL: {},
    "panoptic-no-fixed-2d": {"fixed": 0.0},
    "panoptic-no-3d": {"points": 0.0},
    NO_DEPTH: {},
    UNIFORM: {},
    GRID_LABELS: {"fixed": 0.0, "points": 0.0},
}


def panoptic_arms(folder: Path, *, moving: bool = False) -> dict[str, Arm]:
    """Arms by name, some of them only where cars drive (``moving``); fits are kept in ``folder``."""

    def arm(name: str, classes: str = "learned", *, allowed: bool = False) -> Arm:
        def run(config: StreetsConfig, seed: int) -> ViewScores:
            street = drive(config, seed)
            field = street_field(config, street, name, folder)
            field.shape = msgspec.structs.replace(field.shape, classes=classes)
            return score_street(config, street, lambda frame: render_answer(field, frame, allowed=allowed))

        return run

    names = [name for name in LEFT_OUT if moving or name != STILL]
    rendered = {"panoptic-fixed": arm("panoptic", "fixed"), ALLOWED: arm("panoptic", allowed=True)}
    return {name: arm(name) for name in names} | rendered


def fit_settings(config: StreetsConfig, street: Drive, name: str) -> FinetuneConfig:
    """How an arm's field is fitted."""
    left_out = LEFT_OUT[name]
    cameras = np.array([view.T_world_camera[:3, 3] for view in street.left])
    ahead = np.array([view.T_world_camera[:3, 2] for view in street.left])[-1]
    ends = np.concatenate((cameras - _BEHIND_M * ahead, cameras + _AHEAD_M * ahead))[:, :2]
    aside = _ASIDE_M * np.abs(ahead[[1, 0]])
    low, high = ends.min(axis=0) - aside, ends.max(axis=0) + aside
    box = (float(low[0]), float(low[1]), _LOW_M, float(high[0]), float(high[1]), _HIGH_M)
    grid = GridFitConfig(voxel_m=config.voxel_m, box_m=box, near_m=NEAR_M, held_out=0)
    losses = PanopticFitConfig(**left_out)
    return FinetuneConfig(
        seconds=0.0, steps=config.field_steps, width=config.width, grid=grid, panoptic=losses, seed=config.seed
    )


def field_shape(street: Drive, name: str) -> PanopticConfig:
    """Boxes of an arm's field, and how it samples rays."""
    if name == GRID_LABELS:
        return PanopticConfig()
    boxes = tuple(box_config(primitive(b)) for b in street.boxes if name != STILL or b.stamps is None)
    return PanopticConfig(boxes=boxes, uncovered="empty")


def street_field(config: StreetsConfig, street: Drive, name: str, folder: Path) -> Panoptic:
    """The fitted field of an arm: read from ``folder``, or fitted and kept there."""
    settings = fit_settings(config, street, name)
    text = json.dumps(to_plain(settings) | {"version": VERSION, "suite": streets_digest(config)}, sort_keys=True)
    path = folder / f"{name}-{street.seed}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.safetensors"
    if path.is_file():
        return _of(load_checkpoint(path))
    field_type = UniformPanoptic if name == UNIFORM else Panoptic
    start = field_type(field_shape(street, name), STREETS_SUITE.label_set)
    frames = [*street.frames(), *(view.frame for view in street.right)]
    if name == NO_DEPTH or not config.field_depth:
        frames = [replace(frame, depth_m=None) for frame in frames]
    began = time.process_time()
    checkpoint = finetune(frames, STREETS_SUITE.label_set, start, settings)
    seconds = round(time.process_time() - began, 1)
    _log.info("street_field", arm=name, street=street.seed, cpu_s=seconds, **checkpoint.recipe["panoptic"])
    save_checkpoint(checkpoint, path)
    return _of(load_checkpoint(path))


def render_answer(field: Panoptic, frame: PosedFrame, *, allowed: bool = False) -> Answer:
    """Classes, things and depth of a frame; only its camera is looked at.

    Classes are those of the learned field, as in the paper; ``allowed``: of those that boxes allow at each point, as
    ``Panoptic.classify`` answers where depth was not measured.
    """
    k, pose = frame.intrinsics, torch.from_numpy(frame.T_world_camera).float()
    found: list[tuple[np.ndarray[Any, Any], ...]] = []
    with torch.inference_mode():
        for pixels in pixel_grid(k.width, k.height).split(_AT_ONCE):
            rays = pixel_rays(pixels, k, pose, near_m=NEAR_M, far_m=np.inf, stamp_ns=frame.stamp_ns)
            samples = field.march(rays)
            boxes = field.boxes_on(samples)
            points = boxes.fixed if field.shape.classes == "fixed" else field.learned(samples)
            points = boxes.allowed_of(points) if allowed else points
            points = field.of_movers(samples, points)
            channel = field.composited(samples, points, boxes).argmax(1)
            depth = (ray_fraction(samples) * samples.z).sum(1) / samples.opacity.clamp_min(1e-6)
            depth = torch.where(samples.opacity > 0.5, depth, 0.0)
            found.append((channel.numpy(), field.instances(rays, channel).numpy(), depth.numpy()))
    channel, instance, depth = (np.concatenate(parts).reshape(k.height, k.width) for parts in zip(*found, strict=True))
    things = instance if field.shape.boxes else None
    return Answer(field.label_set.to_ids(channel), things, depth.astype(np.float32))


def _of(checkpoint: Checkpoint) -> Panoptic:
    assert isinstance(checkpoint.model, Panoptic)
    return checkpoint.model.eval()
