"""IRT's arms of AERIAL: all stand on a town's one grid and trunk, and learn classes from the labelled views."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import hashlib
import json
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save

from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import (
    AerialConfig,
    Arm,
    Episode,
    Fit,
    Predict,
    labelled_frames,
    scored,
    thin,
    thinned,
    training_frames,
)
from research.suites.aerial_fields import HELD_OUT_FRACTION
from research.suites.aerial_grids import (
    NEAR_M,
    TownGrid,
    grid_digest,
    grid_settings,
    town_grid,
)
from semantic_mapper.config import IRTConfig, IRTVariant
from semantic_mapper.fields.scene.grid import RaySamples
from semantic_mapper.fields.scene.irt import IRT, TEXTURE, TextureNet
from semantic_mapper.files import write_bytes
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.fit import Budget
from semantic_mapper.training.frame_rays import frame_rays
from semantic_mapper.training.grid_fit import GridFit, fit_trunk, trunk_steps
from semantic_mapper.training.irt import ClassFit, labelled_rays
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import Float32, PosedFrame, UInt8

_log = get_logger(__name__)

VERSION = 1  # raised by a change of the trunk's fit: older files are left alone

_AT_ONCE = 4096  # rays of a picture


def irt_arms(folder: Path) -> dict[str, Arm]:
    """``irt_fits`` as arms."""
    return {name: scored(fit) for name, fit in irt_fits(folder).items()}


class ColourNet(TextureNet):
    """A network of each pixel's colour in place of its patch's texture."""

    layers, kernel = (3, 16, TEXTURE), 1


class ColourIRT(IRT):
    """With the colour of a pixel in place of its texture."""

    texture_net = ColourNet


def irt_fits(folder: Path) -> dict[str, Fit]:
    """Fits by name; grids and trunks are kept in ``folder``, and in memory where the views' rays meet a grid."""
    marched: dict[tuple[int, int, int], list[RaySamples]] = {}  # by town, view and distance of pixels

    def arm(
        variant: IRTVariant = "RTTC",
        *,
        carry: bool = False,
        points: int = 10,
        colour: bool = False,
        stage_1: bool = True,
    ) -> Fit:
        def fit(config: AerialConfig, episode: Episode) -> Predict:
            start = town_grid(config, episode.town, folder)
            frames = labelled_frames(config, episode)
            shape = IRTConfig(
                grid=start.grid.config,
                variant=variant,
                carried=len(frames) if carry else 0,
                carried_size=(config.width, config.width) if carry else (1, 1),
            )
            torch.manual_seed(config.seed)
            field = (ColourIRT if colour else IRT)(shape, AERIAL_SUITE.label_set)
            field.points_of_ray = points
            field.fitted_steps += 1
            if stage_1:
                _load_trunk(config, episode, field, start, folder)
            fit_classes(config, episode, field, frames)
            own: dict[tuple[int, int, int], list[RaySamples]] = marched if stage_1 else {}

            def answer(frame: PosedFrame, every: int) -> UInt8:
                key = episode.town, frame.seq, every
                if key not in own:
                    own[key] = march_frame(field, frame, every)
                return predict(field, frame, every, own[key])

            return answer

        return fit

    variants: dict[str, IRTVariant] = {"irt-b": "B", "irt-rt": "RT", "irt-rtt": "RTT", "irt-rtc": "RTC"}
    arms = {
        "irt-rttc": arm(),
        "irt-bc": arm("BC", carry=True, points=6),
        "irt-carry": arm(carry=True),
        "irt-plain-bc": arm("BC"),
    }
    arms |= {name: arm(variant) for name, variant in variants.items()}
    return arms | {
        "irt-colour": arm(colour=True),
        "irt-20-points": arm(points=20),
        "irt-no-stage-1": arm(stage_1=False),
    }


def fit_classes(config: AerialConfig, episode: Episode, field: IRT, frames: list[PosedFrame]) -> None:
    """Stage 2: classes from the labelled views; one block in eight of these chooses the weights."""
    settings = finetune_settings(config, episode.town)
    fit = ClassFit(field, labelled_rays(frames, AERIAL_SUITE.label_set, settings), settings)
    best, _ = fit.run(Budget(settings.seconds, settings.steps, settings.evaluations))
    field.eval()
    _log.info("irt_fitted", variant=field.shape.variant, step=best.step, accuracy=round(best.accuracy, 4))


def finetune_settings(config: AerialConfig, town: int) -> FinetuneConfig:
    """How classes are learned."""
    fit = grid_settings(config, town)
    return msgspec.structs.replace(fit, steps=config.irt_steps, held_out_fraction=HELD_OUT_FRACTION)


def march_frame(field: IRT, frame: PosedFrame, every: int) -> list[RaySamples]:
    """Where the rays of a frame's ``thinned`` pixels meet the grid, in batches."""
    few = thinned(frame, every)
    rays = frame_rays([few], few.intrinsics.width)
    with torch.inference_mode():
        return [field.march(rays.rays(part, NEAR_M)) for part in _batches(len(rays))]


def predict(field: IRT, frame: PosedFrame, every: int, marched: list[RaySamples]) -> UInt8:
    """Ids of a frame's ``thinned`` pixels; its own image is looked at, the whole of it."""
    views = stack_sources([view_from_frame(frame, field.label_set, frame.intrinsics.width)], with_labels=False)
    found: list[NDArray[np.int64]] = []
    with torch.inference_mode():
        encoded = field.encode(views)
        for samples in marched:
            logits, known = field.classify(samples, encoded)
            found.append(torch.where(known, logits.argmax(1), -1).numpy())
    return field.label_set.to_ids(np.concatenate(found)).reshape(thin(frame.rgb[..., 0], every).shape)


def _batches(count: int) -> list[NDArray[np.int64]]:
    return [np.arange(first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE)]


def _load_trunk(config: AerialConfig, episode: Episode, field: IRT, start: TownGrid, folder: Path) -> None:
    """Grid and trunk of a town into ``field``; the trunk is fitted once and kept in ``folder``."""
    field.grid.load_state_dict(start.grid.state_dict())
    assert field.trunk is not None
    settings = msgspec.structs.replace(grid_settings(config, episode.town), steps=config.trunk_steps)
    shape = (field.shape.features, field.shape.trunk_width)
    plain = [grid_digest(config, episode.town), *shape, config.trunk_steps, VERSION]
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]
    path = folder / f"trunk-{episode.town}-{digest}.safetensors"
    if path.exists():
        field.trunk.load_state_dict(load_file(path))
        return
    frames = training_frames(config, episode)
    gains: Float32 = np.ones((len(frames), 3), np.float32)
    fit = GridFit(field.grid, config.grid_steps, start.psnr, tuple(frames), gains)
    psnr = fit_trunk(field, fit, settings, Budget(settings.seconds, trunk_steps(settings)))
    _log.info("trunk_fitted", town=episode.town, psnr=round(psnr, 2))
    write_bytes(path, save({name: tensor.contiguous() for name, tensor in field.trunk.state_dict().items()}))
