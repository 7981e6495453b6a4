"""A drive along a street of STREETS: pairs of images, depth as stereo matching gives it, and a laser scanner's pixels.

Frames are numbered from 0, 0.8 m apart; both images of a pair have the number. Everything is a pure function of
(version, seed, number).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from research.scenes.config import NoiseConfig
from research.scenes.daylight import pose_of
from research.scenes.render import RenderedView, cast_view, light_seen, seen_labels
from research.scenes.scene import scene_at
from research.scenes.sensor_color import expose
from research.scenes.sensor_depth import depth_edges, hidden_from_other_eye, smooth_noise
from research.scenes.sequence import FRAME_NS, RoomView
from research.scenes.shots import Shot
from research.scenes.streets.layout import STREETS_CODE, STREETS_VERSION, Street, make_streets_street
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, PosedFrame

PAIRS = 24
STEP_M, LANE_M, CAMERA_M = 0.8, -1.5, 1.55  # from pair to pair; left of the middle of the road; above it
BASELINE_M = 0.6
LINES, HIGHEST_DEG, LOWEST_DEG, MAX_RANGE_M = 64, 2.0, -24.8, 100.0  # of the scanner

FULL_WIDTH, FULL_HEIGHT, FULL_FOCAL, FULL_CENTRE = 1408, 376, 552.554261, (682.049453, 238.769549)  # of KITTI-360

_POSE_STREAM, _LIGHT_STREAM, _NOISE_STREAM, _DEPTH_STREAM = 1, 2, 3, 4
_EXPOSURE, _DRIFT, _KNOTS = 1.5, (0.4, 2.5), 5  # linear gain; factors it drifts between, and how often it turns
_FINER = 2  # rays a pixel along each side, for colour
_SIGMA_PX = 0.4  # of the disparity, in pixels of the data set's full width
_HOLES = 0.2  # fraction of the pixels without a measurement
_FAR_PX = 2.0  # disparities below, of the full width, are not measured
_SKY_FILLED = 0.3  # of the sky beside something, that takes its depth
_SKY_REACH = 3  # pixels at 352


@dataclass(frozen=True, slots=True, eq=False)
class StreetPair:
    """Two images of one moment; only the left one has depth and labels."""

    left: RoomView
    right: RoomView


def street_camera(width: int) -> CameraIntrinsics:
    """KITTI-360's left camera at another width; its picture is 1408x376."""
    s = width / FULL_WIDTH
    centre = (FULL_CENTRE[0] * s, FULL_CENTRE[1] * s)
    return CameraIntrinsics(FULL_FOCAL * s, FULL_FOCAL * s, *centre, width, round(FULL_HEIGHT * s))


def street_pose(street: Street, number: float) -> Float64:
    """T_world_camera (4, 4) of the left camera: in the right lane, with the small sway of a car.

    Numbers between those of frames give places between them.
    """
    rng = np.random.default_rng((STREETS_CODE, STREETS_VERSION, street.scene.seed, _POSE_STREAM))
    phase, s = rng.uniform(0, 2 * np.pi, 3), number * STEP_M
    x, y, yaw = street.way.at(s, LANE_M + 0.2 * float(np.sin(s / 17 + phase[0])))
    yaw += 0.2 / 17 * np.cos(s / 17 + phase[0]) + np.radians(0.3) * np.sin(s / 6 + phase[1])
    return pose_of(np.array([x, y, CAMERA_M]), yaw, np.radians(0.35) * np.sin(s / 3.1 + phase[2]))


def street_pairs(
    seed: int, numbers: Iterable[int], intrinsics: CameraIntrinsics, *, moving: bool = False
) -> Iterator[StreetPair]:
    """Pairs in the order of ``numbers``; labels are ids of ``labels.KITTI360``.

    Args:
        seed: Of the street.
        numbers: Of pairs, from 0.
        intrinsics: From ``street_camera``, or any other without distortion.
        moving: Cars drive on the street.
    """
    street = cached_street(seed, moving)
    for number in numbers:
        left = street_pose(street, number)
        right = left.copy()
        right[:3, 3] += BASELINE_M * left[:3, 0]
        yield StreetPair(
            _view(street, intrinsics, left, number, "left"), _view(street, intrinsics, right, number, "right")
        )


def street_views(
    seed: int, numbers: Iterable[int], intrinsics: CameraIntrinsics, *, moving: bool = False
) -> Iterator[RoomView]:
    """The left images of ``street_pairs``."""
    street = cached_street(seed, moving)
    for number in numbers:
        yield _view(street, intrinsics, street_pose(street, number), number, "left")


@lru_cache(maxsize=2)
def cached_street(seed: int, moving: bool = False) -> Street:
    """``make_streets_street``, which a run asks for again and again."""
    return make_streets_street(seed, moving=moving)


def scanned_pixels(intrinsics: CameraIntrinsics) -> Bool:
    """(H, W) which pixels one of 64 scan lines meets, of a scanner in the place of the camera."""
    i = intrinsics
    column = np.arange(i.width)
    azimuth = np.arctan((column - i.cx) / i.fx)
    tilt = np.radians(np.linspace(HIGHEST_DEG, LOWEST_DEG, LINES))
    row = np.rint(i.cy - i.fy * np.tan(tilt)[:, None] / np.cos(azimuth)[None]).astype(int)
    met = np.zeros((i.height, i.width), np.bool_)
    inside = (row >= 0) & (row < i.height)
    met[row[inside], np.broadcast_to(column, row.shape)[inside]] = True
    return met


def exposures(seed: int, count: int) -> Float64:
    """(count,) factors of the light, which drift through 0.4 to 2.5."""
    rng = np.random.default_rng((STREETS_CODE, STREETS_VERSION, seed, _LIGHT_STREAM))
    knots = rng.uniform(np.log(_DRIFT[0]), np.log(_DRIFT[1]), _KNOTS)
    return np.exp(np.interp(np.linspace(0, _KNOTS - 1, max(count, 2)), np.arange(_KNOTS), knots))[:count]


def stereo_depth(exact_m: Float32, intrinsics: CameraIntrinsics, rng: np.random.Generator) -> Float32:
    """Depth (H, W) float32 as semi-global matching of two images of full width gives it, 0 = no measurement.

    Disparities have an error of 0.4 pixels of the full width; a fifth of the pixels is lost, most of them along edges
    and where the other eye sees nothing; and some of the sky beside something takes its depth.

    Args:
        exact_m: (H, W) z-depth, 0 = the sky.
        intrinsics: Of the image.
        rng: Draws the errors.
    """
    scale = FULL_WIDTH / intrinsics.width
    seen = exact_m > 0
    near = exact_m.copy()
    reach = max(1, round(_SKY_REACH * intrinsics.width / 352))
    beside = np.where(seen, exact_m, np.inf).astype(np.float32)
    beside = np.asarray(cv2.erode(beside, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)), np.float32)
    filled = ~seen & np.isfinite(beside) & (_patches(seen.shape, rng) < _SKY_FILLED)
    near[filled] = beside[filled]
    known = near > 0
    disparity = np.where(known, scale * intrinsics.fx * BASELINE_M / np.where(known, near, 1.0), 0.0).astype(np.float32)
    error = 0.6 * rng.standard_normal(seen.shape, np.float32) + 0.8 * smooth_noise(seen.shape, rng)
    noisy = np.round(16 * (disparity + np.float32(_SIGMA_PX) * error)) / 16
    lost = hidden_from_other_eye(disparity / np.float32(scale)) & known
    lost |= depth_edges(near, 0.06) & (rng.random(seen.shape) < 0.5)
    wanted = _HOLES * seen.sum() - (lost & seen).sum()
    left = seen & ~lost
    if wanted > 0 and left.any():
        field = _patches(seen.shape, rng)
        lost |= field <= np.quantile(field[left], min(wanted / left.sum(), 1.0))
    measured = known & ~lost & (noisy > _FAR_PX)
    return np.where(measured, scale * intrinsics.fx * BASELINE_M / np.maximum(noisy, 1e-3), 0.0).astype(np.float32)


def _patches(shape: tuple[int, ...], rng: np.random.Generator) -> Float64:
    """(H, W) numbers that are uniform over 0 to 1, alike within some pixels."""
    field = smooth_noise(shape, rng) + 0.5 * rng.standard_normal(shape, np.float32)
    return field.ravel().argsort().argsort().reshape(shape) / field.size


def _view(street: Street, intrinsics: CameraIntrinsics, pose: Float64, number: int, side: str) -> RoomView:
    scene, i, n = scene_at(street.scene, number), intrinsics, _FINER
    depth, index = cast_view(scene, i, pose)
    exact = np.where(index >= 0, depth, 0.0).astype(np.float32)
    centre = (n - 1) / 2
    finer = CameraIntrinsics(n * i.fx, n * i.fy, n * i.cx + centre, n * i.cy + centre, n * i.width, n * i.height)
    light = light_seen(scene, finer, pose, *cast_view(scene, finer, pose))
    linear = np.asarray(cv2.resize(light, (i.width, i.height), interpolation=cv2.INTER_AREA), np.float32)
    gain = _EXPOSURE * exposures(scene.seed, PAIRS)[number % PAIRS]
    shot = Shot(np.full(3, gain), 1.0, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    seeds = (STREETS_CODE, STREETS_VERSION, scene.seed)
    noise = np.random.default_rng((*seeds, _NOISE_STREAM, number, side == "right"))
    rgb = expose(linear, exact, i, shot, NoiseConfig(depth="none", auto_exposure=0.0), noise)
    instance = np.append(scene.primitives.instance, np.uint16(0))[index]
    label, measured = seen_labels(scene, index), np.zeros_like(exact)
    if side == "left":
        measured = stereo_depth(exact, i, np.random.default_rng((*seeds, _DEPTH_STREAM, number)))
    frame = PosedFrame(
        stamp_ns=(number + 1) * FRAME_NS,
        seq=number,
        camera_id=side,
        rgb=rgb,
        depth_m=measured if side == "left" else None,
        label=label if side == "left" else None,
        intrinsics=i,
        T_world_camera=pose,
        pose_source="streets",
    )
    return RoomView(frame, RenderedView(rgb, measured, label, instance, exact), pose)
