"""Arms of KLEVR that look at single images: the check of the suite itself, and the per-image U-Net."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import hashlib
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import torch
from safetensors.torch import save
from torch import nn
from torch.nn import functional

from research.scenes.suite import KLEVR_SUITE
from research.suites.kept import read_json, read_network
from research.suites.klevr import (
    POINTS,
    TEST_CAMERAS,
    Arm,
    ArmScores,
    KlevrConfig,
    confusion,
    labelled_frames,
    scene_frames,
    score_images,
    scored_numbers,
    surface_points,
    train_seeds,
)
from research.suites.plateau import fit_to_plateau
from semantic_mapper.config import to_plain
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.files import write_bytes
from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig
from semantic_mapper.types import Float32, PosedFrame, UInt8

_log = get_logger(__name__)

_CHECKED_SCENES = 8  # of training, at test cameras: where the U-Net's plateau is looked for
_SAME_SURFACE_M = 0.15  # of z: a pixel is 0.14 m wide at the distance of the origin
_VERSION = 1  # raised by a change of the U-Net's training: older networks are left alone


def image_arms(folder: Path) -> dict[str, Arm]:
    """Arms by name; the U-Net is kept in ``folder``."""
    return {"color": color_arm, "unet": partial(unet_arm, folder=folder)}


def color_arm(config: KlevrConfig) -> ArmScores:
    """What the colour of a pixel alone says of its class: a small network on RGB."""
    frames, label_set = labelled_frames(config), KLEVR_SUITE.label_set
    torch.manual_seed(config.seed)
    net = nn.Sequential(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, len(label_set)))
    rgb = np.concatenate([f.rgb.reshape(-1, 3) for f in frames])
    channel = np.concatenate([label_set.to_channels(f.label).ravel() for f in frames if f.label is not None])
    rng, optimiser = np.random.default_rng(config.seed), torch.optim.Adam(net.parameters(), 3e-3)
    for _ in range(config.mlp_steps):
        pick = rng.integers(len(rgb), size=8192)
        loss = functional.cross_entropy(net(_color_input(rgb[pick])), torch.from_numpy(channel[pick]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    def predict(frame: PosedFrame) -> UInt8:
        with torch.inference_mode():
            found = net(_color_input(frame.rgb.reshape(-1, 3))).argmax(1).numpy()
        return label_set.to_ids(found).reshape(frame.rgb.shape[:2])

    return ArmScores(score_images(config, predict))


def unet_arm(config: KlevrConfig, folder: Path) -> ArmScores:
    """The per-image U-Net on the same label maps, its steps doubled until its plateau.

    The plateau is looked for at test cameras of training scenes. Points take the class that most of the train cameras
    that see them say.
    """
    unet, gain = unet_network(config, folder)
    found = score_images(config, unet.predict)
    for scene, matrices in found.items():
        xyz, truth = surface_points(config, scene)
        matrix = matrices[POINTS] = ConfusionMatrix(KLEVR_SUITE.label_set)
        matrix.update(truth, vote_at_points(config, scene, xyz, unet.predict), f"points of scene {scene}")
    return ArmScores(found, gain, unet.config.steps)


def unet_network(config: KlevrConfig, folder: Path) -> tuple[UNetBaseline, float]:
    """The U-Net of the arm, and the mIoU that the last fifth of its steps brought."""
    return fit_to_plateau(lambda steps: _fit_unet(config, folder, steps), config.unet_steps, config.doublings)


def vote_at_points(config: KlevrConfig, scene: int, xyz: Float32, predict: Callable[[PosedFrame], UInt8]) -> UInt8:
    """Ids (N,) of points (N, 3) on the surface: what most of the scene's train cameras that see one say there."""
    label_set = KLEVR_SUITE.label_set
    votes = np.zeros((len(xyz), len(label_set)), np.int64)
    for frame in scene_frames(config, scene, range(config.train_views)):
        assert frame.depth_m is not None
        p = transform(invert_pose(frame.T_world_camera), xyz.astype(np.float64))
        inside, row, column = nearest_pixels(p, frame.intrinsics)
        seen = np.flatnonzero(inside & (np.abs(frame.depth_m[row, column] - p[:, 2]) < _SAME_SURFACE_M))
        votes[seen, label_set.to_channels(predict(frame))[row[seen], column[seen]]] += 1
    return label_set.to_ids(votes.argmax(1))


def _fit_unet(config: KlevrConfig, folder: Path, steps: int) -> tuple[UNetBaseline, float]:
    """The U-Net of so many steps, read from ``folder`` or fitted and kept there, and what the last fifth of the steps
    brought at test cameras of training scenes."""
    settings = UNetConfig(steps=steps, width=config.width, seed=config.seed)
    unet = UNetBaseline(KLEVR_SUITE.label_set, settings)
    path = folder / f"unet-{_unet_digest(config, settings)}.safetensors"
    kept = read_json(path.with_suffix(".json"), float)
    if kept is not None and read_network(path, unet.net):
        return unet, kept
    checked = [f for s in train_seeds(config)[:_CHECKED_SCENES] for f in _held_out(config, s)]
    before: list[float] = []

    def look(fraction: float) -> None:
        if fraction >= 0.8 and not before:
            unet.net.eval()
            before.append(_miou(checked, unet))
            unet.net.train()

    unet.fit(labelled_frames(config), look)
    reached = _miou(checked, unet)
    gain = reached - (before[0] if before else 0.0)  # a handful of steps has no last fifth
    _log.info("unet_fitted", steps=steps, last_fifth=round(gain, 4), miou=round(reached, 4))
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(path.with_suffix(".json"), msgspec.json.encode(gain))
    write_bytes(path, save({name: tensor.contiguous() for name, tensor in unet.net.state_dict().items()}))
    return unet, gain


def _unet_digest(config: KlevrConfig, settings: UNetConfig) -> str:
    seen = {name: getattr(config, name) for name in ("train_scenes", "views", "train_views", "label_maps", "variant")}
    plain = [to_plain(settings), seen, KLEVR_SUITE.version, _VERSION]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def _miou(frames: list[PosedFrame], unet: UNetBaseline) -> float:
    return confusion(frames, unet.predict).metrics().miou or 0.0


def _held_out(config: KlevrConfig, scene: int) -> list[PosedFrame]:
    return scene_frames(config, scene, scored_numbers(config, scene)[TEST_CAMERAS])


def _color_input(rgb: UInt8) -> torch.Tensor:
    return torch.from_numpy(rgb.astype(np.float32) / 255)
