"""Depth cameras by name: what a stereo camera makes of the exact depth.

Both sensors match pixels between two eyes, so errors arise in disparity and grow with the square of range: noise
(independent and correlated), quantisation, a ceiling at short range, a band beside near things that one eye does not
see, blobs without measurement on surfaces without texture (passive sensors) or too dark and far for the projector
(active ones), holes along edges, and near things that grow there by half a matching window.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from research.scenes.config import DepthSensorName
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

_NATIVE_WIDTH = 1280  # pixels; disparities of both sensors are counted at this width
_IID_SHARE, _CORRELATED_SHARE = 0.6, 0.8  # of sigma; their squares add up to 1
_CORRELATION_PX = 8
_EDGE_RATIO, _EDGE_HOLE_SHARE = 0.06, 0.35  # a step of depth of this fraction is an edge; holes along it
_FATTEN_SHARE = 0.65  # of the edge pixels take the nearer depth
_TEXTURE_WINDOW = 9
_TEXTURE_WIDTH = 0.5  # grey levels over which holes become likely
_THRESHOLD_SIGMA = 0.3  # of the texture threshold from place to place, grey levels


@dataclass(frozen=True, slots=True)
class StereoSensor:
    """One stereo camera.

    Args:
        baseline_m: Between the eyes.
        sigma_px: Noise of the disparity, pixels at a width of 1280.
        step_px: Disparities are multiples of this.
        max_disparity_px: Nearer things are not measured.
        max_depth_m: Farther things are not measured.
        min_texture: Local contrast in grey levels below which matching fails; 0 for a sensor with a projector.
        min_return: Grey levels over square metres below which the projector's pattern is lost; 0 for a passive one.
        slanted: Surfaces return less of the pattern the flatter they are seen, as those before a laser's dots do.
    """

    baseline_m: float
    sigma_px: float
    step_px: float
    max_disparity_px: float
    max_depth_m: float
    min_texture: float
    min_return: float
    slanted: bool = False


STEREO_SENSORS: dict[str, StereoSensor] = {
    "oak_d": StereoSensor(0.075, 0.12, 1 / 8, 95.0, 12.0, 1.1, 0.0),
    "d435": StereoSensor(0.050, 0.08, 1 / 32, 126.0, 8.0, 0.0, 2.0),
    "kinect": StereoSensor(0.075, 0.1, 1 / 8, 175.0, 8.0, 0.0, 4.0, slanted=True),  # the first: structured light
}


def measure_depth(
    exact_m: Float32, rgb: UInt8, intrinsics: CameraIntrinsics, sensor: DepthSensorName, rng: np.random.Generator
) -> Float32:
    """Depth (H, W) float32 as the sensor gives it, 0 = no measurement.

    Args:
        exact_m: (H, W) z-depth, 0 = nothing there.
        rgb: (H, W, 3) picture of the same view; its contrast decides where a passive sensor can match.
        intrinsics: Of both.
        sensor: "exact" gives a copy, "none" zeros.
        rng: Draws the errors.
    """
    if sensor == "exact":
        return exact_m.copy()
    if sensor == "none":
        return np.zeros_like(exact_m)
    model = STEREO_SENSORS[sensor]
    focal_base = intrinsics.fx * _NATIVE_WIDTH / intrinsics.width * model.baseline_m  # native pixels times metres
    hit = exact_m > 0
    disparity = np.where(hit, focal_base / np.where(hit, exact_m, 1.0), 0.0).astype(np.float32)
    window = max(1, round(intrinsics.width / 320))
    disparity = _fatten_edges(disparity, window, rng)
    hidden = hidden_from_other_eye(disparity * (intrinsics.width / _NATIVE_WIDTH))
    shape = exact_m.shape
    noise = _IID_SHARE * rng.standard_normal(shape, np.float32) + _CORRELATED_SHARE * smooth_noise(shape, rng)
    noisy = disparity + np.float32(model.sigma_px) * noise
    noisy = np.round(noisy / np.float32(model.step_px)) * np.float32(model.step_px)
    seen = (disparity > 0) & (noisy > 0) & ~hidden & (noisy <= model.max_disparity_px)
    seen &= ~(depth_edges(exact_m, _EDGE_RATIO) & (rng.random(shape, np.float32) < _EDGE_HOLE_SHARE))
    if model.min_texture > 0:
        seen &= _has_texture(rgb, model.min_texture, rng)
    if model.min_return > 0:
        level = _facing(exact_m, intrinsics) if model.slanted else 1.0
        seen &= _returns_light(rgb, exact_m, model.min_return / level, rng)
    depth = focal_base / np.where(seen, noisy, 1.0)
    return np.where(seen & (depth <= model.max_depth_m), depth, 0.0).astype(np.float32)


def hidden_from_other_eye(disparity_px: Float32) -> np.ndarray:
    """(H, W) bool: pixels of the left eye that the right eye, a baseline to the right, does not see.

    A pixel at column u stands at u - disparity in the right image; it is hidden where a pixel further right in the
    left image stands there or further left.
    """
    column = np.arange(disparity_px.shape[1], dtype=np.float32)
    other = column - disparity_px
    first = np.minimum.accumulate(other[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(disparity_px.shape, np.bool_)
    hidden[:, :-1] = first[:, 1:] <= other[:, :-1]
    return hidden


def depth_edges(depth_m: Float32, ratio: float) -> np.ndarray:
    """(H, W) bool: pixels with a neighbour (4) whose depth differs by more than ``ratio`` of the nearer one's."""
    edge = np.zeros(depth_m.shape, np.bool_)
    step = np.abs(np.diff(depth_m, axis=0)) > ratio * np.minimum(depth_m[1:], depth_m[:-1])
    edge[1:] |= step
    edge[:-1] |= step
    step = np.abs(np.diff(depth_m, axis=1)) > ratio * np.minimum(depth_m[:, 1:], depth_m[:, :-1])
    edge[:, 1:] |= step
    edge[:, :-1] |= step
    return edge


def _fatten_edges(disparity: Float32, radius: int, rng: np.random.Generator) -> Float32:
    """Near things cover their surroundings by ``radius`` pixels, in places."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    grown = np.asarray(cv2.dilate(disparity, kernel), np.float32)
    some = rng.random(disparity.shape, np.float32) < _FATTEN_SHARE
    return np.where(some & (grown > disparity * 1.06), grown, disparity)


def smooth_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Float32:
    """(H, W) noise of unit variance that is alike within ``_CORRELATION_PX``."""
    height, width = shape
    coarse = rng.standard_normal((height // _CORRELATION_PX + 2, width // _CORRELATION_PX + 2), np.float32)
    field = np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    return field / max(float(field.std()), 1e-6)


def _facing(exact_m: Float32, intrinsics: CameraIntrinsics) -> Float32:
    """(H, W) cosine of the angle at which surfaces are seen, at least 0.05."""
    z = np.maximum(exact_m, 1e-3)
    across = np.gradient(z, axis=1) * np.float32(intrinsics.fx) / z
    down = np.gradient(z, axis=0) * np.float32(intrinsics.fy) / z
    return np.maximum(1.0 / np.sqrt(1.0 + across * across + down * down), np.float32(0.05))


def _returns_light(rgb: UInt8, exact_m: Float32, least: Float32 | float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool: the projected pattern is bright enough; it gets weaker with the square of range."""
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (5, 5), 1.2).astype(np.float32) + 8.0
    threshold = least * np.exp(0.5 * smooth_noise(grey.shape, rng))
    return grey > threshold * exact_m * exact_m


def _has_texture(rgb: UInt8, least: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) bool: local contrast above a threshold that differs from place to place."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    grey = cv2.GaussianBlur(grey, (5, 5), 1.2).astype(np.float32)  # matching costs average the pixel noise away
    size = (_TEXTURE_WINDOW, _TEXTURE_WINDOW)
    mean = cv2.boxFilter(grey, -1, size)
    variance = cv2.boxFilter(grey * grey, -1, size) - mean * mean
    contrast = np.sqrt(np.maximum(variance, 0.0))
    threshold = least + _THRESHOLD_SIGMA * smooth_noise(grey.shape, rng)
    threshold += _TEXTURE_WIDTH * (rng.random(grey.shape, np.float32) - 0.5)
    return contrast > threshold
