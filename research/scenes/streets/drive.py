"""A street under an open sky: what a car's camera and laser scanner see of it, with classes of KITTI-360.

The primitives and their casting are those of the rooms; the light is the sun's, with one shadow map, and the sky's. The
street runs along x. It stands far from the origin of its world, as recorded drives do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.config import NoiseConfig
from research.scenes.daylight import Daylight, pose_of, shadow_map, sun_camera
from research.scenes.materials import Pattern, display_hsv, material_table
from research.scenes.primitives import Assembly, Shape, pack
from research.scenes.render import cast_view, light_seen, seen_labels
from research.scenes.scene import NO_LAMPS, Scene
from research.scenes.sensor_color import expose
from research.scenes.shots import Shot
from research.scenes.streets.builder import StreetBuilder, clouds
from research.scenes.streets.parts import house, tree
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

ORIGIN_M = np.array([830.0, 3700.0, 115.0])  # where the street begins: on the road, in its middle
BEYOND_M = 120.0  # of street that goes on behind the last frame
STEP_M = 0.8  # of the car from frame to frame
CAMERA_M = 1.55  # height above the road
SCANNER_M = np.array([-0.8, 0.0, 1.73])  # place of the scanner beside the foot of the camera: back, left, up
RINGS_DEG = np.linspace(2.0, -24.8, 64)  # elevation of the scanner's beams
AZIMUTH_DEG = 0.18
MAX_RANGE_M = 45.0
RANGE_SIGMA_M = 0.02
GLASS_RETURN = 0.3  # probability that a beam comes back from a window

_ROAD, _LANE = 4.0, 2.2  # half the width of the road; width of the strip on which cars park
_KERB_M = 0.13
_SHADOW_SIZE, _SUN_M = 3000, 4000.0  # pixels a side of the shadow map; distance of the sun's camera
_SHADOW_BIAS_M = 0.25
_SKY_SHADE = 0.45  # light of the sky, as a fraction of the sun's
_HAZE_M = 700.0
_GRID = 4  # pixels of the scanner's depth image in one step of its azimuth


@dataclass(frozen=True, slots=True, eq=False)
class StreetView:
    """One frame: rgb (H, W, 3) uint8, label (H, W) uint8 ids, exact_depth_m (H, W) float32, 0 = sky."""

    rgb: UInt8
    label: UInt8
    exact_depth_m: Float32


CLASSES = (
    "road", "sidewalk", "parking", "terrain", "building", "wall", "fence", "vegetation", "car", "sky", "pole",
    "traffic sign", "smallpole", "lamp", "trash bin",
)  # fmt: skip


def make_street(seed: int, length_m: float, label_set: LabelSet) -> Scene:
    """Build a street; everything follows from the arguments.

    Args:
        seed: Of everything that is drawn.
        length_m: Way of the car; the street goes on for ``BEYOND_M``.
        label_set: Whose ids labels are; has the names ``CLASSES``.
    """
    b = StreetBuilder(np.random.default_rng((seed, 360)), ORIGIN_M)
    end = length_m + BEYOND_M
    _ground(b, end)
    for side in (1.0, -1.0):  # left with a strip for parking, right without
        verge = _ROAD + (_LANE if side > 0 else 0.0)
        _sidewalk(b, side, verge, end)
        _plots(b, side, verge + 2.4, end)
        _furniture(b, side, verge + 0.5, end)
        _cars(b, side, verge, end)
    far = Assembly("vegetation")
    for k in range(24):  # a wood closes the street off
        far.ellipsoid(b.pick(b.leaves), (0, (k - 12) * 9.0, b.between(2, 5)), (14, 16, b.between(12, 22)))
    b.place(far, end + 60, 0)
    primitives = pack(b.groups, label_set)
    azimuth, elevation = b.between(0, 2 * np.pi), np.radians(b.between(30, 55))
    horizon = display_hsv(0.57, b.between(0.05, 0.2), 0.97)
    zenith = display_hsv(0.6, b.between(0.3, 0.6), b.between(0.75, 0.95))
    sun, T_world_sun = sun_camera(ORIGIN_M + np.array([end / 2, 0.0, 0.0]), azimuth, elevation, _SUN_M)
    focal = _SHADOW_SIZE / 2 * _SUN_M / (end / 2 + 40.0)
    shadow = shadow_map(primitives, T_world_sun, focal, _SHADOW_SIZE)
    daylight = Daylight(
        "sky", sun, shadow, T_world_sun, focal, _SHADOW_BIAS_M, _SKY_SHADE, (horizon, zenith), clouds(b.rng), _HAZE_M
    )
    size = (1e6, 1e6, 1e6)
    return Scene(seed, "street", size, primitives, material_table(b.materials), NO_LAMPS, (), label_set, daylight)


def drive(street: Scene, count: int) -> Float64:
    """Poses T_world_camera (count, 4, 4), ``STEP_M`` apart, in the right lane, with the small sway of a car."""
    rng = np.random.default_rng((street.seed, 361))
    phase = rng.uniform(0, 2 * np.pi, 3)
    x = np.arange(count) * STEP_M
    y = -1.6 + 0.25 * np.sin(x / 17 + phase[0])
    yaw = 0.25 / 17 * np.cos(x / 17 + phase[0]) + np.radians(0.3) * np.sin(x / 6 + phase[1])
    pitch = np.radians(0.35) * np.sin(x / 3.1 + phase[2])
    place = ORIGIN_M + np.stack((x, y, np.full(count, CAMERA_M)), axis=1)
    return np.array([pose_of(place[k], yaw[k], pitch[k]) for k in range(count)])


def render_street(
    street: Scene, intrinsics: CameraIntrinsics, T_world_camera: Float64, shot: Shot, config: NoiseConfig, seed: int
) -> StreetView:
    """What the camera sees.

    Args:
        street: From ``make_street``.
        intrinsics: Pinhole without distortion.
        T_world_camera: (4, 4).
        shot: Exposure and motion of this frame.
        config, seed: Noise of the colour camera.
    """
    depth, index = cast_view(street, intrinsics, T_world_camera)
    linear = light_seen(street, intrinsics, T_world_camera, depth, index)
    exact = np.where(index >= 0, depth, 0.0).astype(np.float32)
    rgb = expose(linear, exact, intrinsics, shot, config, np.random.default_rng((street.seed, seed, 362)))
    return StreetView(rgb, seen_labels(street, index), exact)


def scan_street(street: Scene, T_world_scanner: Float64, seed: int) -> Float32:
    """Points (N, 4) that the laser scanner measures ahead of it: x ahead, y left, z up in metres, and reflectance.

    Only what lies within 52 degrees of straight ahead, which is more than the camera sees.

    Args:
        street: From ``make_street``.
        T_world_scanner: (4, 4), axes as those of the points.
        seed: Of the noise.
    """
    rng = np.random.default_rng((street.seed, seed, 363))
    T_world_ahead = T_world_scanner.copy()  # camera axes
    T_world_ahead[:3, :3] = T_world_scanner[:3, :3] @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    focal = _GRID / np.radians(AZIMUTH_DEG)
    azimuth = np.radians(np.arange(-52, 52, AZIMUTH_DEG))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, np.radians(RINGS_DEG)))
    width, height = 2 * int(np.tan(np.radians(53)) * focal), 2 * int(np.tan(np.radians(38)) * focal)
    u, v = np.tan(a), np.tan(e) / np.cos(a)  # left and up, on the plane ahead
    ahead = CameraIntrinsics(focal, focal, width / 2 - 0.5, height / 2 - 0.5, width, height)
    depth, index = cast_view(street, ahead, T_world_ahead)
    row = np.rint(height / 2 - 0.5 - v * focal).astype(int)
    column = np.rint(width / 2 - 0.5 - u * focal).astype(int)
    z, hit = depth[row, column], index[row, column]
    way = z * np.sqrt(1 + u * u + v * v)
    found = (hit >= 0) & (way < MAX_RANGE_M)
    glossy = street.materials.gloss[street.primitives.material[hit]] > 0.5
    found &= ~glossy | (rng.random(len(z)) < GLASS_RETURN)
    z, u, v, way = z[found], u[found], v[found], way[found]
    points = np.stack((z, z * u, z * v), axis=1) * (1 + rng.normal(0, RANGE_SIGMA_M, len(z)) / way)[:, None]
    reflectance = street.materials.color_a[street.primitives.material[hit[found]]].mean(axis=1)
    return np.concatenate((points, reflectance[:, None]), axis=1).astype(np.float32)


def _ground(b: StreetBuilder, end: float) -> None:
    asphalt = b.material(Pattern.PLAIN, (0.6, 0.04, b.between(0.38, 0.5)), scale_m=0.5, dim=0.75)
    paving = b.material(Pattern.TILES, (0.08, 0.08, 0.6), scale_m=0.2, dim=0.6)
    grass = b.material(Pattern.PRINT, (0.25, 0.5, 0.5), scale_m=0.4, dim=0.6)
    long, middle = end + 160.0, end / 2 + 40.0
    road = Assembly("road")
    road.box(asphalt, (0, 0, -0.1), (long, 2 * _ROAD, 0.2))
    for k in range(int(end / 6) + 3):
        road.box(b.grey[2], (-middle + 6.0 * k, 0, 0.003), (2.5, 0.12, 0.006))
    b.place(road, middle, 0)
    lane = Assembly("parking")
    lane.box(paving, (0, _ROAD + _LANE / 2, -0.09), (long, _LANE, 0.2))
    b.place(lane, middle, 0)
    terrain = Assembly("terrain")
    terrain.box(grass, (0, 0, -0.3), (long + 600, 900, 0.5))
    b.place(terrain, middle, 0)


def _sidewalk(b: StreetBuilder, side: float, verge: float, end: float) -> None:
    paving = b.material(Pattern.TILES, (0.07, 0.05, b.between(0.55, 0.75)), scale_m=0.4, dim=0.7)
    walk = Assembly("sidewalk")
    walk.box(paving, (0, side * (verge + 1.2), 0), (end + 160, 2.4, 2 * _KERB_M))
    walk.box(b.grey[1], (0, side * (verge + 0.08), 0.005), (end + 160, 0.16, 2 * _KERB_M))
    b.place(walk, end / 2 + 40, 0)


def _plots(b: StreetBuilder, side: float, front: float, end: float) -> None:
    """Houses with gardens, or a green between them; a fence, wall or hedge in front."""
    x = -20.0
    while x < end:
        width, setback = b.between(11, 19), b.between(2.0, 7.0)
        middle = x + width / 2
        if b.rng.uniform() < 0.82:
            home = house(b, width - b.between(1.0, 5.0)).assembly
            b.place(home, middle, side * (front + setback), yaw=0.0 if side > 0 else np.pi)
        else:
            for _ in range(3):
                _tree(b, middle + b.between(-5, 5), side * (front + b.between(3, 12)))
        border = Assembly(("fence", "wall", "vegetation", "terrain")[int(b.rng.choice(4, p=(0.3, 0.2, 0.25, 0.25)))])
        height = b.between(0.8, 1.6)
        if border.label == "fence":
            board = b.pick(b.wood)
            for k in range(int(width / 0.5)):
                border.box(board, (-width / 2 + 0.5 * k, 0, height / 2), (0.34, 0.04, height))
            border.box(board, (0, 0.03, height * 0.7), (width, 0.04, 0.1))
        elif border.label == "wall":
            brick = b.material(Pattern.TILES, (0.03, b.between(0.1, 0.5), 0.6), scale_m=0.25, dim=0.7)
            border.box(brick, (0, 0, height / 2), (width - 1.5, 0.25, height))
        elif border.label == "vegetation":
            border.box(b.pick(b.leaves), (0, 0, height / 2), (width - 1, 0.7, height))
        if border.parts:
            b.place(border, middle, side * (front + 0.3))
        if b.rng.uniform() < 0.5:
            _tree(b, middle + b.between(-6, 6), side * (front + b.between(0.8, max(setback - 0.5, 1.0))))
        x += width


def _tree(b: StreetBuilder, x: float, y: float) -> None:
    b.place(tree(b), x, y)


def _furniture(b: StreetBuilder, side: float, y: float, end: float) -> None:
    """Lamp posts, signs, bins and small trees along the kerb."""
    x = b.between(-10, 0)
    while x < end:
        kind = int(b.rng.choice(4, p=(0.35, 0.25, 0.15, 0.25)))
        thing = Assembly("pole")
        if kind == 0:
            high = b.between(4.5, 6.5)
            thing.cylinder(b.grey[0], (0, 0, high / 2), (0.14, 0.14, high))
            thing.box(b.grey[0], (0, -0.5, high), (0.08, 1.1, 0.08))
            thing.box(b.grey[2], (0, -1.0, high), (0.2, 0.5, 0.12), label="lamp")
        elif kind == 1:
            paint = b.material(Pattern.PRINT, (b.between(0, 1), 0.8, 0.8), scale_m=0.2)
            thing.cylinder(b.grey[0], (0, 0, 1.2), (0.07, 0.07, 2.4), label="smallpole")
            thing.box(paint, (-0.05, 0, 2.5), (0.03, 0.65, 0.65), label="traffic sign")
        elif kind == 2:
            for k in range(int(b.rng.integers(1, 4))):
                bin_paint = b.material(Pattern.PLAIN, (b.between(0.2, 0.6), 0.4, 0.35), scale_m=0.3)
                thing.box(bin_paint, (0.7 * k, 0, 0.55), (0.58, 0.7, 1.1), label="trash bin")
        if kind == 3:
            _tree(b, x, side * (y + 0.2))
        else:
            b.place(thing, x, side * y, z=_KERB_M, yaw=0.0 if side > 0 else np.pi)
        x += b.between(6, 15)


def _cars(b: StreetBuilder, side: float, verge: float, end: float) -> None:
    x = b.between(4, 12)
    while x < end:
        car = Assembly("car")
        hue, grey = b.between(0, 1), b.rng.uniform() < 0.6
        paint = b.material(
            Pattern.PLAIN, (hue, 0.04 if grey else 0.7, b.between(0.12, 0.95)), scale_m=1.0, gloss=0.4, dim=0.95
        )
        tyre = b.grey[0]
        long, high = b.between(3.8, 4.8), b.between(1.4, 1.7)
        car.box(paint, (0, 0, 0.56), (long, 1.75, 0.62))
        car.ellipsoid(paint, (long * 0.42, 0, 0.6), (long * 0.3, 1.72, 0.6))
        car.box(b.glass[0], (-0.2, 0, (0.85 + high) / 2), (long * 0.48, 1.5, high - 0.85))
        car.box(paint, (-0.25, 0, high), (long * 0.36, 1.48, 0.08))
        car.box(b.glass[0], (long * 0.22, 0, (0.8 + high) / 2 - 0.05), (long * 0.16, 1.45, (high - 0.8) * 0.6))
        for end_x in (-0.32, 0.32):
            for across in (-0.8, 0.8):
                car.add(Shape.CYLINDER, tyre, (end_x * long, across, 0.31), (0.62, 0.62, 0.22), tilt=np.pi / 2)
        y = side * (verge - _LANE / 2) if side > 0 else side * (_ROAD - 1.0)
        b.place(car, x, y + b.between(-0.1, 0.1), yaw=0.0 if b.rng.uniform() < 0.7 else np.pi)
        x += b.between(5.5, 9) if side > 0 and b.rng.uniform() < 0.7 else b.between(14, 40)
