"""Flights over a town: orbits at three heights, a ring low between the houses, and what the camera sees.

Views of a flight are numbered in the order of the flight; every fifth is held out. Everything is a pure function of
(version, seed, number).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from research.scenes.aerial.plan import TownPlan
from research.scenes.aerial.town import AERIAL_CODE, AERIAL_VERSION, Town, make_town
from research.scenes.config import NoiseConfig
from research.scenes.daylight import pose_of
from research.scenes.render import RenderedView, cast_view, light_seen, seen_labels
from research.scenes.sensor_color import expose
from research.scenes.sequence import FRAME_NS, RoomView
from research.scenes.shots import Shot
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

FLIGHT, LOW_RING = 100, 12  # views; those of the ring are numbered from ``FLIGHT`` on
TEST_EVERY, TEST_OFFSET = 5, 2
LOW_M = 15.0
FIELD_OF_VIEW_DEG = 50.0

_POSE_STREAM, _LABEL_STREAM, _LIGHT_STREAM, _NOISE_STREAM = 1, 2, 3, 4
_DARK = (0.15, 0.4)  # fraction of the light
_EXPOSURE = 1.7
_FINER = 2  # rays a pixel along each side, for colour
_CLEARANCE_M = 3.0


@dataclass(frozen=True, slots=True)
class Orbit:
    """A round at one height, with its number of views, pitch in degrees below the horizon, and radius as a fraction
    of half the town's longer side."""

    height_m: float
    views: int
    pitch_deg: tuple[float, float]
    radius: tuple[float, float]


ORBITS = (
    Orbit(120.0, 34, (62.0, 75.0), (0.2, 0.7)),
    Orbit(80.0, 33, (50.0, 62.0), (0.5, 0.85)),
    Orbit(40.0, 33, (35.0, 50.0), (0.45, 0.95)),
)


def aerial_camera(width: int) -> CameraIntrinsics:
    """A square picture of 50 degrees."""
    focal, middle = width / 2 / float(np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))), (width - 1) / 2
    return CameraIntrinsics(focal, focal, middle, middle, width, width)


def held_out_numbers() -> list[int]:
    """Views of the flight that are held out."""
    return list(range(TEST_OFFSET, FLIGHT, TEST_EVERY))


def training_numbers() -> list[int]:
    """The other views of the flight."""
    return [n for n in range(FLIGHT) if n % TEST_EVERY != TEST_OFFSET]


def low_numbers() -> list[int]:
    """Views of the low ring."""
    return list(range(FLIGHT, FLIGHT + LOW_RING))


def labelled_numbers(seed: int, choice: int, count: int, among: Sequence[int] | None = None) -> list[int]:
    """Training views that bring their labels: one in each of ``count`` sectors, which begin at a random azimuth.

    Args:
        seed: Of the town.
        choice: Each is another draw.
        count: At least 1. Sectors have the same number of views.
        among: Training views to choose from; None = all.
    """
    rng = np.random.default_rng((AERIAL_CODE, AERIAL_VERSION, seed, _LABEL_STREAM, choice))
    start = rng.uniform(0, 2 * np.pi)
    numbers = np.array(training_numbers() if among is None else among)
    azimuth = np.array([(_azimuth(seed, int(n)) - start) % (2 * np.pi) for n in numbers])
    return sorted(int(rng.choice(sector)) for sector in np.array_split(numbers[azimuth.argsort()], count))


def aerial_pose(town: Town, number: int) -> Float64:
    """T_world_camera (4, 4) of a view."""
    seed = town.scene.seed
    rng = np.random.default_rng((AERIAL_CODE, AERIAL_VERSION, seed, _POSE_STREAM, number))
    if number >= FLIGHT:
        return _low_pose(town, number - FLIGHT, rng)
    orbit, _ = _orbit_of(number)
    azimuth, radius = _azimuth(seed, number), rng.uniform(*orbit.radius) * town.plan.reach_m
    place = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), orbit.height_m + rng.uniform(-3, 3)])
    yaw = azimuth + np.pi + np.radians(rng.uniform(-40, 40))
    return pose_of(place, yaw, -np.radians(rng.uniform(*orbit.pitch_deg)), np.radians(rng.uniform(-2, 2)))


def aerial_views(
    seed: int, numbers: Iterable[int], intrinsics: CameraIntrinsics, *, dark: bool = False
) -> Iterator[RoomView]:
    """Labelled views (ids of ``labels.CARLA``) in the order of ``numbers``; frames have no depth.

    Args:
        seed: Of the town.
        numbers: Below ``FLIGHT`` of the flight, from there on of the low ring.
        intrinsics: From ``aerial_camera``, or any other without distortion.
        dark: The same views with 0.15 to 0.4 of the light and twice the read noise.
    """
    town = cached_town(seed)
    for number in numbers:
        pose = aerial_pose(town, number)
        view = render_town(town, intrinsics, pose, number, dark=dark)
        frame = PosedFrame(
            stamp_ns=(number + 1) * FRAME_NS,
            seq=number,
            camera_id="drone",
            rgb=view.rgb,
            depth_m=None,
            label=view.label,
            intrinsics=intrinsics,
            T_world_camera=pose,
            pose_source="aerial",
        )
        yield RoomView(frame, view, pose)


@lru_cache(maxsize=2)
def cached_town(seed: int) -> Town:
    """``make_town``, which a run asks for again and again."""
    return make_town(seed)


def primitives_seen(seed: int, number: int, intrinsics: CameraIntrinsics) -> np.ndarray:
    """Numbers (H, W) of the primitives that a view shows, -1 = the sky."""
    town = cached_town(seed)
    return cast_view(town.scene, intrinsics, aerial_pose(town, number))[1]


def render_town(
    town: Town, intrinsics: CameraIntrinsics, pose: Float64, number: int, *, dark: bool = False
) -> RenderedView:
    """A picture from anywhere over a town; ``number`` draws its noise."""
    scene, i, n = town.scene, intrinsics, _FINER
    depth, index = cast_view(scene, i, pose)
    exact = np.where(index >= 0, depth, 0.0).astype(np.float32)
    centre = (n - 1) / 2
    finer = CameraIntrinsics(n * i.fx, n * i.fy, n * i.cx + centre, n * i.cy + centre, n * i.width, n * i.height)
    light = light_seen(scene, finer, pose, *cast_view(scene, finer, pose))
    linear = np.asarray(cv2.resize(light, (i.width, i.height), interpolation=cv2.INTER_AREA), np.float32)
    read_noise = NoiseConfig().read_noise
    if dark:
        rng = np.random.default_rng((AERIAL_CODE, AERIAL_VERSION, scene.seed, _LIGHT_STREAM, number))
        linear, read_noise = linear * np.float32(rng.uniform(*_DARK)), 2 * read_noise
    config = NoiseConfig(depth="none", auto_exposure=0.0, read_noise=read_noise)
    shot = Shot(np.full(3, _EXPOSURE), 1.0, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    rng = np.random.default_rng((AERIAL_CODE, AERIAL_VERSION, scene.seed, _NOISE_STREAM, number, dark))
    rgb = expose(linear, exact, i, shot, config, rng)
    instance = np.append(scene.primitives.instance, np.uint16(0))[index]
    return RenderedView(rgb, np.zeros_like(exact), seen_labels(scene, index), instance, exact)


def _orbit_of(number: int) -> tuple[Orbit, int]:
    """The orbit of a view of the flight, and its number in it."""
    for orbit in ORBITS:
        if number < orbit.views:
            return orbit, number
        number -= orbit.views
    raise IndexError(number)


def _azimuth(seed: int, number: int) -> float:
    """Where a view of the flight lies round the centre, radians."""
    orbit, place = _orbit_of(number)
    rng = np.random.default_rng((AERIAL_CODE, AERIAL_VERSION, seed, _POSE_STREAM, 1000 + round(orbit.height_m)))
    return float(rng.uniform(0, 2 * np.pi) + 2 * np.pi * place / orbit.views)


def _low_pose(town: Town, place: int, rng: np.random.Generator) -> Float64:
    """Over a street, looking towards the centre; never inside of something."""
    low, high = town.scene.primitives.bounds()
    while True:
        azimuth = 2 * np.pi * (place + rng.uniform(0, 1)) / LOW_RING
        radius = rng.uniform(0.45, 0.95) * town.plan.reach_m
        spot = _over_street(town.plan, radius * np.cos(azimuth), radius * np.sin(azimuth))
        inside = (spot > low - _CLEARANCE_M) & (spot < high + _CLEARANCE_M)
        if not inside.all(axis=1).any():
            break
    yaw = np.arctan2(-spot[1], -spot[0]) + np.radians(rng.uniform(-25, 25))
    return pose_of(spot, yaw, -np.radians(rng.uniform(25, 40)))


def _over_street(plan: TownPlan, x: float, y: float) -> Float64:
    """The nearest place over the middle of a street."""
    xs, ys = np.array(plan.xs), np.array(plan.ys)
    near_x, near_y = xs[np.abs(xs - x).argmin()], ys[np.abs(ys - y).argmin()]
    if abs(near_x - x) < abs(near_y - y):
        x = float(near_x)
    else:
        y = float(near_y)
    return np.array([x, y, LOW_M])
