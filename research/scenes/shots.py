"""What the camera does with each frame of a sequence: exposure, white balance, look, motion of the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.config import SUITE_VERSION, NoiseConfig
from semantic_mapper.geometry import interpolate_pose, invert_pose, rotation_vector
from semantic_mapper.types import Float64

_SHOT_STREAM, _CAMERA_STREAM = 2, 9  # numbers of the random streams; rooms and paths use others
_GREY = 0.12  # fraction of the sequences that are nearly without colour
_KEEP = 0.93  # of the drift from one frame to the next
_TURN_WEIGHT_M = 0.35  # a turn of one radian counts as this much way


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """How one frame is taken.

    Args:
        gain: (3,) float64 factors of linear RGB: exposure times white balance.
        contrast: Exponent of the tone curve, 1 = neutral.
        saturation: 1 = neutral, 0 = grey.
        iso: Factor of the noise variance.
        vignetting: Loss of light in the corners, 0 to 1.
        lens_blur_px: Standard deviation, for a width of 320.
        T_open_close: (4, 4) pose of the camera when the shutter closes, in its frame when it opens.
    """

    gain: Float64
    contrast: float
    saturation: float
    iso: float
    vignetting: float
    lens_blur_px: float
    T_open_close: Float64


def sequence_shots(poses: Float64, seed: int, config: NoiseConfig, camera: int | None = None) -> list[Shot]:
    """One ``Shot`` for each of the poses (N, 4, 4): one camera and one look, exposure and white balance that drift,
    and motion towards the next pose. Deterministic in its arguments; shot k does not depend on later ones' number.
    Sequences of one ``camera`` have its look; by default each has a camera of its own."""
    rng = np.random.default_rng((SUITE_VERSION, seed, _SHOT_STREAM))
    look, blur = _look(rng, config)
    if camera is not None:
        look, blur = _look(np.random.default_rng((SUITE_VERSION, camera, _CAMERA_STREAM)), config)
    state = rng.standard_normal(3)
    shots: list[Shot] = []
    for k, pose in enumerate(poses):
        if k:
            state = _KEEP * state + np.sqrt(1 - _KEEP**2) * rng.standard_normal(3)
        way = blur * config.max_blur_way_m * rng.uniform() ** 2
        after = poses[k + 1] if k + 1 < len(poses) else pose
        shots.append(Shot(_gain(state, config), *look, T_open_close=motion_between(pose, after, way)))
    return shots


def single_shot(seed: int, config: NoiseConfig) -> Shot:
    """A ``Shot`` of a camera at rest, for a view that belongs to no sequence."""
    rng = np.random.default_rng((SUITE_VERSION, seed, _SHOT_STREAM))
    look, _ = _look(rng, config)
    return Shot(_gain(rng.standard_normal(3), config), *look, T_open_close=np.eye(4))


def _look(rng: np.random.Generator, config: NoiseConfig) -> tuple[tuple[float, float, float, float, float], float]:
    """Contrast, saturation, ISO factor, vignetting and lens blur of one camera; and the factor of its motion blur."""
    contrast = 1.0 + config.look * rng.uniform(-0.15, 0.5)
    saturation = 1.0 + config.look * rng.uniform(-0.45, 0.25)
    if rng.uniform() < _GREY:
        saturation = max(0.0, 1.0 - config.look * rng.uniform(0.8, 1.0))
    iso, blur = float(2.0 ** rng.uniform(-1.0, 1.5)), 1.0
    if rng.uniform() < config.rough:
        iso, blur = iso * rng.uniform(1.5, 6.0), rng.uniform(1.0, 3.0)
    vignetting, lens = config.max_vignetting * rng.uniform(), config.max_lens_blur_px * rng.uniform()
    return (contrast, saturation, iso, vignetting, lens), blur


def _gain(state: Float64, config: NoiseConfig) -> Float64:
    exposure = 2.0 ** (config.exposure_stops * state[0])
    return exposure * np.exp(config.white_balance * np.array([state[1], 0.0, state[2]]))


def motion_between(pose: Float64, after: Float64, way_m: float) -> Float64:
    """(4, 4) the part of the motion from ``pose`` to ``after`` that is ``way_m`` long; identity where both are one."""
    T = invert_pose(pose) @ after
    full = float(np.hypot(np.linalg.norm(T[:3, 3]), _TURN_WEIGHT_M * np.linalg.norm(rotation_vector(T))))
    return interpolate_pose(np.eye(4), T, min(way_m / full, 1.0) if full > 0 else 0.0)
