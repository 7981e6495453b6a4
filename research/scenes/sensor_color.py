"""The colour camera: linear light -> 8-bit picture, with exposure, blur, noise, vignetting and a tone curve."""

from __future__ import annotations

import cv2
import numpy as np

from research.kernels import kernel
from research.scenes.config import NoiseConfig
from research.scenes.shots import Shot
from semantic_mapper.geometry import expect_shape, invert_pose
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

_TABLE_SIZE = 4096
_TABLE_TOP = 4.0  # linear light that the tone table ends at
_PIXEL_BLUR_PX = 0.45  # standard deviation of what one pixel collects: rays hit points, pixels see areas
_WELL_EXPOSED = 0.42  # mean linear light that the automatic exposure aims at
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def develop(linear: Float32) -> UInt8:
    """What a perfect camera gives of linear RGB (..., 3): highlights roll off, gamma 2.2."""
    position = np.sqrt(np.clip(linear, 0.0, _TABLE_TOP) / _TABLE_TOP) * (_TABLE_SIZE - 1)
    return _NEUTRAL[(position + 0.5).astype(np.int32)]


def expose(
    linear: Float32,
    depth_m: Float32,
    intrinsics: CameraIntrinsics,
    shot: Shot,
    config: NoiseConfig,
    rng: np.random.Generator,
) -> UInt8:
    """What a real camera gives of linear RGB (H, W, 3).

    Motion blur is an approximation in the picture plane: each pixel is the mean of samples along its own motion, which
    follows from its depth; what a moving edge uncovers is not rendered.
    """
    moved = blur_motion(linear, depth_m, intrinsics, shot)
    if shot.lens_blur_px > 0:
        sigma = float(np.hypot(_PIXEL_BLUR_PX, shot.lens_blur_px * intrinsics.width / 320))
        moved = np.asarray(cv2.GaussianBlur(moved, (0, 0), sigma), np.float32)
    mean = float(moved[::4, ::4].mean(axis=(0, 1)) @ _LUMA)
    auto = float(np.clip(_WELL_EXPOSED / max(mean, 1e-3), 0.4, 3.0)) ** config.auto_exposure
    gain = (shot.gain * auto).astype(np.float32)
    noise = rng.standard_normal(linear.shape, np.float32)
    # Noise scales with the gain that the camera applies to what reaches the sensor.
    shot_noise = config.shot_noise * shot.iso * max(auto, 1.0)
    read_noise = config.read_noise * float(np.sqrt(shot.iso)) * max(auto, 1.0)
    table = _tone_table(shot.contrast)
    return _develop(moved, noise, gain, shot.vignetting, shot.saturation, shot_noise, read_noise, table)


def blur_motion(linear: Float32, depth_m: Float32, intrinsics: CameraIntrinsics, shot: Shot) -> Float32:
    """Mean of 7 samples of (H, W, 3) along each pixel's motion while the shutter is open."""
    if np.array_equal(shot.T_open_close, np.eye(4)):
        return linear
    i = intrinsics
    expect_shape(linear, f"{i.height} {i.width} 3", "linear")
    expect_shape(depth_m, f"{i.height} {i.width}", "depth_m")
    linear, depth_m, out = np.ascontiguousarray(linear), np.ascontiguousarray(depth_m), linear.copy()
    T_close_open = np.ascontiguousarray(invert_pose(shot.T_open_close), np.float64)
    _blur_motion(linear, depth_m, T_close_open, i.fx, i.fy, i.cx, i.cy, out)
    return out


def _develop(
    linear: Float32,
    noise: Float32,
    gain: Float32,
    corner: float,
    saturation: float,
    shot_noise: float,
    read_noise: float,
    table: UInt8,
) -> UInt8:
    """(H, W, 3) uint8 of linear RGB (H, W, 3) and as many numbers of the normal distribution.

    Args:
        linear, noise: (H, W, 3) float32.
        gain: (3,) float32.
        corner, saturation, shot_noise, read_noise: Rounded to float32.
        table: (T,) uint8 grey levels; see ``_tone_table``.
    """
    out = np.empty(linear.shape, np.uint8)
    scale = (len(table) - 1) / _TABLE_TOP**0.5
    linear = np.ascontiguousarray(linear)
    develop_image(linear, noise, gain, corner, saturation, shot_noise, read_noise, scale, table, out)
    return out


@kernel
def _blur_motion(
    linear: Float32,
    depth_m: Float32,
    T_close_open: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    out: Float32,
) -> None:
    """Write the mean of samples of ``linear`` (H, W, 3) along each pixel's motion to ``out``, which is a copy of it."""
    ...


@kernel
def develop_image(
    linear: Float32,
    noise: Float32,
    gain: Float32,
    corner: float,
    saturation: float,
    shot_noise: float,
    read_noise: float,
    scale: float,
    table: UInt8,
    out: UInt8,
) -> None:
    """Write ``out``; see ``_develop``. ``scale``: entries of the table a square root of linear light."""
    ...


def _tone_table(contrast: float) -> UInt8:
    """(4096,) grey levels over the square root of linear light; ``contrast`` turns the curve about mid grey."""
    x = np.linspace(0.0, 1.0, _TABLE_SIZE) ** 2 * _TABLE_TOP
    rolled = x * (1.0 + x / 9.0) / (1.0 + x)  # Reinhard with white at 3
    display = np.minimum(rolled, 1.0) ** (1 / 2.2)
    curved = np.where(
        display < 0.5, 0.5 * (2 * display) ** contrast, 1 - 0.5 * np.maximum(2 - 2 * display, 0) ** contrast
    )
    return np.clip(curved * 255.0 + 0.5, 0, 255).astype(np.uint8)


_NEUTRAL = _tone_table(1.0)
