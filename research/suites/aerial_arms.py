"""Arms of AERIAL that look at single images: the checks of the suite itself, and the per-image U-Net."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from research.scenes.aerial.views import cached_town, primitives_seen
from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import (
    DAY,
    AerialConfig,
    Arm,
    Counts,
    Episode,
    Fit,
    Predict,
    labelled_frames,
    scored,
    scored_views,
    thin,
)
from research.suites.plateau import fit_to_plateau
from research.suites.scene_runs import ViewScores
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig
from semantic_mapper.types import Float32, PosedFrame, SourceViews, UInt8

_log = get_logger(__name__)

BRIDGE, ROOF = "bridge or road", "roof or road"  # what the patches are asked
PATCH = 7  # pixels a side
DARKEST = 0.15  # light of the U-Net's darkest pictures where it is trained with such

_BATCH = 4096
_GAMMA = 2.2  # of the camera's pictures
_MOST_DOUBLINGS = 3
_BLOCK = 16  # pixels a side of what is held out of labelled views
_HELD_OUT = 8  # one block in so many


def fit_color(config: AerialConfig, episode: Episode) -> Predict:
    """What the colour of a pixel alone says of its class: a small network on RGB."""
    frames, label_set = labelled_frames(config, episode), AERIAL_SUITE.label_set
    rgb = np.concatenate([_unit(f.rgb.reshape(-1, 3)) for f in frames])
    channel = np.concatenate([label_set.to_channels(f.label).ravel() for f in frames if f.label is not None])
    net = _fit_mlp(rgb[channel >= 0], channel[channel >= 0], len(label_set), config)

    def predict(frame: PosedFrame, every: int) -> UInt8:
        rgb = thin(frame.rgb, every)
        with torch.inference_mode():
            found = net(torch.from_numpy(_unit(rgb.reshape(-1, 3)))).argmax(1).numpy()
        return label_set.to_ids(found).reshape(rgb.shape[:2])

    return predict


def patch_arm(config: AerialConfig, episode: Episode) -> ViewScores:
    """Whether patches of 7x7 pixels tell bridges and flat roofs from roads of the same asphalt.

    As many patches of either are learned from the labelled views and asked for in the test views. Where the labelled
    views show only one of the two, nothing is scored.
    """
    found: dict[str, dict[int, Counts]] = {}
    label_set = AERIAL_SUITE.label_set
    road = label_set.names.index("roads")
    for kind, name in ((BRIDGE, "bridge"), (ROOF, "building")):
        other = label_set.names.index(name)
        learned = [_asphalt_patches(f, episode, name) for f in labelled_frames(config, episode)]
        sides = [np.concatenate([pair[k] for pair in learned]) for k in range(2)]
        if not all(map(len, sides)):
            continue
        rng = np.random.default_rng((config.seed, episode.number))
        count = max(map(len, sides))
        sides = [side[rng.integers(len(side), size=count)] for side in sides]
        net = _fit_mlp(np.concatenate(sides), np.repeat((0, 1), count), 2, config)
        found[kind] = {}
        for view in scored_views(config, episode, DAY):
            matrix = ConfusionMatrix(label_set)
            for truth, patches in enumerate(_asphalt_patches(view.frame, episode, name)):
                with torch.inference_mode():
                    said = net(torch.from_numpy(patches)).argmax(1).numpy()
                for answer in range(2):
                    matrix.counts[(road, other)[truth], (road, other)[answer]] = int((said == answer).sum())
            found[kind][view.frame.seq] = matrix.counts
    return found


class DimmedUNet(UNetBaseline):
    """A U-Net for whose training images are scaled by a number from ``darkest`` to 1, in linear light."""

    def __init__(self, label_set: LabelSet, config: UNetConfig, darkest: float) -> None:
        super().__init__(label_set, config)
        self.darkest = darkest

    def varied(self, sources: SourceViews, generator: torch.Generator) -> SourceViews:
        """As the base's, and dimmed."""
        sources = super().varied(sources, generator)
        if self.darkest == 1:
            return sources
        light = self.darkest + (1 - self.darkest) * torch.rand(len(sources.rgb), 1, 1, 1, generator=generator)
        return replace(sources, rgb=sources.rgb * light ** (1 / _GAMMA))


def unet_fit(darkest: float = 1.0) -> Fit:
    """The per-image U-Net on the labelled views, past its plateau; ``darkest``: see ``DimmedUNet``.

    One block in eight of the labelled views is held out. The network is fitted again with twice the steps until those
    after four fifths of them bring less than half a point of mIoU there.
    """

    def run(config: AerialConfig, episode: Episode) -> Predict:
        frames = labelled_frames(config, episode)
        seen, held_out = _split(frames, np.random.default_rng((config.seed, episode.number, 3)))

        def fit(steps: int) -> tuple[UNetBaseline, float]:
            return _fit_unet(config, seen, held_out, steps, darkest)

        unet, _ = fit_to_plateau(fit, config.unet_steps, _MOST_DOUBLINGS, a_loss_ends_it=True)
        return lambda frame, every: thin(unet.predict(frame), every)

    return run


IMAGE_FITS: dict[str, Fit] = {"color": fit_color, "unet": unet_fit(), "unet-dimmed": unet_fit(DARKEST)}
IMAGE_ARMS: dict[str, Arm] = {"patch": patch_arm} | {name: scored(fit) for name, fit in IMAGE_FITS.items()}


def _fit_unet(
    config: AerialConfig, frames: list[PosedFrame], held_out: list[PosedFrame], steps: int, darkest: float
) -> tuple[UNetBaseline, float]:
    """A U-Net fitted to ``frames``, and what the last fifth of the steps brought at ``held_out``."""
    settings = UNetConfig(steps=steps, width=config.width, batch=2, seed=config.seed)
    unet = DimmedUNet(AERIAL_SUITE.label_set, settings, darkest)
    before: list[float] = []

    def look(fraction: float) -> None:
        if fraction >= 0.8 and not before:
            unet.net.eval()
            before.append(_miou(held_out, unet))
            unet.net.train()

    unet.fit(frames, look)
    reached = _miou(held_out, unet)
    gain = reached - (before[0] if before else 0.0)  # a handful of steps has no last fifth
    _log.info("unet_fitted", steps=steps, last_fifth=round(gain, 4), miou=round(reached, 4), darkest=darkest)
    return unet, gain


def _miou(frames: Sequence[PosedFrame], unet: UNetBaseline) -> float:
    total = ConfusionMatrix(AERIAL_SUITE.label_set)
    for frame in frames:
        assert frame.label is not None
        total.update(frame.label, unet.predict(frame), f"view {frame.seq}")
    return total.metrics().miou or 0.0


def _split(frames: Sequence[PosedFrame], rng: np.random.Generator) -> tuple[list[PosedFrame], list[PosedFrame]]:
    """Labelled frames with one block in eight ignored, and the same frames with those blocks alone."""
    ignore = AERIAL_SUITE.label_set.ignore_id
    seen, held_out = list[PosedFrame](), list[PosedFrame]()
    for frame in frames:
        assert frame.label is not None
        size = [-(-n // _BLOCK) for n in frame.label.shape]
        blocks = rng.integers(_HELD_OUT, size=size) == 0
        out = blocks.repeat(_BLOCK, 0).repeat(_BLOCK, 1)[: frame.label.shape[0], : frame.label.shape[1]]
        seen.append(replace(frame, label=np.where(out, ignore, frame.label).astype(np.uint8)))
        held_out.append(replace(frame, label=np.where(out, frame.label, ignore).astype(np.uint8)))
    return seen, held_out


def _asphalt_patches(frame: PosedFrame, episode: Episode, name: str) -> tuple[Float32, Float32]:
    """Patches (N, 147) round pixels of the streets' asphalt: on roads, and on what has the class ``name``."""
    town = cached_town(episode.town)
    index = primitives_seen(episode.town, frame.seq, frame.intrinsics)
    primitives = town.scene.primitives
    asphalt = (index >= 0) & (primitives.material[index] == town.asphalt)
    border = PATCH // 2
    padded = np.pad(_unit(frame.rgb), ((border, border), (border, border), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (PATCH, PATCH), axis=(0, 1))  # (H, W, 3, 7, 7)
    ids = [AERIAL_SUITE.label_set.id_of(n) for n in ("roads", name)]
    road, other = (windows[asphalt & (primitives.label[index] == i)].reshape(-1, 3 * PATCH**2) for i in ids)
    return road, other


def _fit_mlp(inputs: Float32, channel: NDArray[np.int64], classes: int, config: AerialConfig) -> nn.Sequential:
    """A network of two hidden layers of 64 on (N, D) inputs."""
    torch.manual_seed(config.seed)
    width = inputs.shape[1]
    net = nn.Sequential(nn.Linear(width, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, classes))
    rng, optimiser = np.random.default_rng(config.seed), torch.optim.Adam(net.parameters(), 3e-3, weight_decay=1e-4)
    target = torch.from_numpy(channel.astype(np.int64))
    for _ in range(config.mlp_steps):
        pick = rng.integers(len(inputs), size=_BATCH)
        loss = functional.cross_entropy(net(torch.from_numpy(inputs[pick])), target[pick])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return net.eval()


def _unit(rgb: UInt8) -> Float32:
    return rgb.astype(np.float32) / np.float32(255)
