"""The colour camera: linear light -> 8-bit picture, with exposure, blur, noise, vignetting and a tone curve."""

from __future__ import annotations

import cv2
import numpy as np

from semantic_mapper.geometry import invert_pose
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.scenes.config import NoiseConfig
from semantic_mapper.scenes.shots import Shot
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

_TABLE_SIZE = 4096
_TABLE_TOP = 4.0  # linear light that the tone table ends at
_WELL_EXPOSED = 0.42  # mean linear light that the automatic exposure aims at
_TAPS = 7  # samples along the motion of a pixel
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
    sigma = shot.lens_blur_px * intrinsics.width / 320
    if sigma > 0.15:
        moved = np.asarray(cv2.GaussianBlur(moved, (0, 0), sigma), np.float32)
    mean = float(moved[::4, ::4].mean(axis=(0, 1)) @ _LUMA)
    auto = float(np.clip(_WELL_EXPOSED / max(mean, 1e-3), 0.4, 3.0)) ** config.auto_exposure
    gain = (shot.gain * auto).astype(np.float32)
    grain = rng.standard_normal(linear.shape, np.float32)
    # Noise scales with the gain that the camera applies to what reaches the sensor.
    shot_noise = np.float32(config.shot_noise * shot.iso * max(auto, 1.0))
    read_noise = np.float32(config.read_noise * np.sqrt(shot.iso) * max(auto, 1.0))
    table = _tone_table(shot.contrast)
    corner = np.float32(shot.vignetting)
    return _develop(moved, grain, gain, corner, np.float32(shot.saturation), shot_noise, read_noise, table)


def blur_motion(linear: Float32, depth_m: Float32, intrinsics: CameraIntrinsics, shot: Shot) -> Float32:
    """Mean of ``_TAPS`` samples of (H, W, 3) along each pixel's motion while the shutter is open."""
    if np.array_equal(shot.T_open_close, np.eye(4)):
        return linear
    i = intrinsics
    return _blur(linear, depth_m, invert_pose(shot.T_open_close), i.fx, i.fy, i.cx, i.cy)


@kernel(error_model="numpy")
def _blur(linear, depth_m, T_close_open, fx, fy, cx, cy):  # type: ignore[no-untyped-def]
    height, width = depth_m.shape
    out = linear.copy()
    R, t = T_close_open[:3, :3], T_close_open[:3, 3]
    for v in range(height):
        for u in range(width):
            z = depth_m[v, u]
            if z <= 0:
                continue
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            depth_then = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            if depth_then <= 0.02:
                continue
            du = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / depth_then * fx + cx - u
            dv = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / depth_then * fy + cy - v
            if du * du + dv * dv < 0.25:
                continue
            r, g, b = 0.0, 0.0, 0.0
            for k in range(_TAPS):
                share = k / (_TAPS - 1) - 0.5
                col = min(max(int(np.floor(u + share * du + 0.5)), 0), width - 1)
                row = min(max(int(np.floor(v + share * dv + 0.5)), 0), height - 1)
                r += linear[row, col, 0]
                g += linear[row, col, 1]
                b += linear[row, col, 2]
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = r / _TAPS, g / _TAPS, b / _TAPS
    return out


@kernel(error_model="numpy")
def _develop(linear, grain, gain, corner, saturation, shot_noise, read_noise, table):  # type: ignore[no-untyped-def]
    height, width, _ = linear.shape
    out = np.empty((height, width, 3), np.uint8)
    scale = np.float32((table.shape[0] - 1) / np.sqrt(_TABLE_TOP))
    last = table.shape[0] - 1
    row_span, col_span = np.float32(2.0 / (height - 1 + 1e-6)), np.float32(2.0 / (width - 1 + 1e-6))
    for v in range(height):
        y = v * row_span - np.float32(1.0)
        for u in range(width):
            x = u * col_span - np.float32(1.0)
            light = np.float32(1.0) - corner * np.float32(0.5) * (x * x + y * y)
            r, g, b = linear[v, u, 0] * gain[0], linear[v, u, 1] * gain[1], linear[v, u, 2] * gain[2]
            grey = np.float32(0.299) * r + np.float32(0.587) * g + np.float32(0.114) * b
            for i in range(3):
                value = r if i == 0 else (g if i == 1 else b)
                value = max((grey + saturation * (value - grey)) * light, np.float32(0.0))
                value += grain[v, u, i] * np.sqrt(shot_noise * value + read_noise * read_noise)
                position = np.sqrt(max(value, np.float32(0.0))) * scale + np.float32(0.5)
                out[v, u, i] = table[min(int(position), last)]
    return out


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
