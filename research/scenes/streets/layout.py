"""The grammar of STREETS: straight, bent or with a side street; parked vehicles, sidewalks, gardens, houses.

Everything is a pure function of (version, seed). The car starts at the origin and drives along x at first; z is up and
the road lies at 0. A *way* gives places by the metres ``s`` driven and metres ``left`` of the middle of the road.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from research.scenes.daylight import Daylight, shadow_map, sun_camera
from research.scenes.materials import display_hsv, material_table
from research.scenes.people import Walk
from research.scenes.primitives import Assembly, pack, place_parts
from research.scenes.scene import NO_LAMPS, Scene
from research.scenes.streets import parts
from research.scenes.streets.builder import SuiteBuilder, clouds
from research.scenes.streets.outlines import (
    Outline,
    Placed,
    boxes_round,
    house_outlines,
    prism_outline,
    tree_outlines,
)
from semantic_mapper.labels import KITTI360
from semantic_mapper.types import Float64

STREETS_VERSION = 1  # part of every seed: a change that alters a street raises it
STREETS_CODE = 3602  # tells the random streams of this suite from those of others
IGNORED = ("pole", "sign")  # rendered, but not evaluated

BEHIND_M = 14.0  # of street behind the first frame
KERB_M = 0.12
ROAD_M, PARKING_M, WALK_M = 3.4, 2.3, 2.1  # half the width of the road; widths of the strip for parking and sidewalk

_SCENE_STREAM, _TRAFFIC_STREAM = 0, 7
_LENGTH_M = (60.0, 86.0)  # of street ahead of the first frame
_RADIUS_M = (70.0, 140.0)
_GARDENS_M = 45.0  # from the sidewalk to where the terrain ends
_DRIVE_M = 3.1  # width of a driveway
_BAY_M = 6.3  # length of a place for a vehicle
_SUN_M, _SHADOW_SIZE = 4000.0, 2400
_SHADOW_BIAS_M, _SKY_SHADE, _HAZE_M = 0.2, 0.45, 700.0
_FAR = 12  # hills, and as many woods

Quad = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Way:
    """The middle of the road: a straight line, or an arc of ``curvature`` per metre, to the left where positive."""

    curvature: float

    def at(self, s: float, left: float) -> tuple[float, float, float]:
        """x, y, yaw of a place."""
        k = self.curvature
        if k == 0.0:
            return s, left, 0.0
        yaw = s * k
        return float(np.sin(yaw)) * (1 / k - left), (1 - float(np.cos(yaw))) / k + left * float(np.cos(yaw)), yaw


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """A street with what its scene does not tell.

    Args:
        scene: Label set ``KITTI360``.
        way: Of the road.
        placed: By group of the scene's primitives.
    """

    scene: Scene
    way: Way
    placed: tuple[Placed, ...]


def make_streets_street(seed: int, *, moving: bool = False) -> Street:
    """The street of ``seed``.

    Args:
        seed: Not negative.
        moving: Cars drive on it, too; ``scene_at`` says where they are in a frame.
    """
    rng = np.random.default_rng((STREETS_CODE, STREETS_VERSION, seed, _SCENE_STREAM))
    kind = int(rng.integers(3))  # straight, arc, side street
    curvature = float(rng.choice([-1.0, 1.0]) / rng.uniform(*_RADIUS_M)) if kind == 1 else 0.0
    b = _Layout(rng, Way(curvature), float(rng.uniform(*_LENGTH_M)))
    crossing = float(rng.uniform(22.0, 38.0)) if kind == 2 else None
    crossed = float(rng.choice([-1.0, 1.0]))
    _road(b)
    for side in (1.0, -1.0):
        at = crossing if side == crossed else None
        parking = side > 0 or b.rng.uniform() < 0.5
        _side(b, side, parking, at)
    if crossing is not None:
        _side_street(b, crossing, crossed)
    _surroundings(b)
    walks: tuple[Walk, ...] = ()
    if moving:
        rest, b.rng = b.rng, np.random.default_rng((STREETS_CODE, STREETS_VERSION, seed, _TRAFFIC_STREAM))
        walks, b.rng = _traffic(b), rest
    primitives = pack(b.groups, KITTI360)
    if moving:
        still = ~np.isin(primitives.group, [walk.group for walk in walks])  # shadows are those of what stands still
        primitives = replace(primitives, casts_shadow=primitives.casts_shadow & still)
    nowhere, table = (np.inf, np.inf, np.inf), material_table(b.materials)
    scene = Scene(seed, "street", nowhere, primitives, table, NO_LAMPS, walks, KITTI360)
    return Street(replace(scene, daylight=_daylight(b, scene)), b.way, tuple(b.placed))


class _Layout(SuiteBuilder):
    """A builder that knows the way and keeps outlines.

    Args:
        rng: Of everything that is drawn.
        way: Of the road.
        length: Metres of street ahead of the first frame.
    """

    def __init__(self, rng: np.random.Generator, way: Way, length: float) -> None:
        super().__init__(rng, np.zeros(3))
        self.way, self.length = way, length
        self.placed: list[Placed] = []

    def along(self, assembly: Assembly, s: float, left: float, *, turn: float = 0.0, z: float = 0.0) -> None:
        """Put an assembly down beside the way, ``turn`` from its direction, with an outline of each of its objects."""
        self.stand(assembly, s, left, boxes_round(assembly), turn=turn, z=z)

    def stand(
        self,
        assembly: Assembly,
        s: float,
        left: float,
        outlines: tuple[Outline, ...],
        *,
        turn: float = 0.0,
        z: float = 0.0,
    ) -> None:
        """Put an assembly with given outlines down beside the way."""
        x, y, yaw = self.way.at(s, left)
        position, yaw = np.array([x, y, z]), yaw + turn
        self.groups.append(place_parts(assembly, yaw, position))
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = position
        self.placed.append(Placed(outlines, T))

    def ground(self, label: str, material: int, s: tuple[float, float], left: tuple[float, float], top: float) -> None:
        """A strip of ground along the way, in pieces of which each follows it."""
        piece = 8.0 if self.way.curvature else 30.0
        count = max(int(np.ceil((s[1] - s[0]) / piece)), 1)
        for a, b in _pairs(np.linspace(*s, count + 1)):
            corners = [self.way.at(*p)[:2] for p in ((a, left[0]), (b, left[0]), (b, left[1]), (a, left[1]))]
            self.slab(label, material, tuple(corners), top)

    def slab(self, label: str, material: int, corners: Quad, top: float) -> None:
        """A convex piece of ground with corners in the world, anticlockwise, down to 0.5 m."""
        solid = Assembly(label)
        solid.prism(material, corners, (-0.5, top))
        self.groups.append(place_parts(solid, 0.0, np.zeros(3)))
        self.placed.append(Placed((prism_outline(label, np.array(corners), (top - 0.15, top + 0.15)),), np.eye(4)))


def _pairs(values: Float64) -> Iterator[tuple[float, float]]:
    yield from ((float(a), float(b)) for a, b in pairwise(values))


def _road(b: _Layout) -> None:
    b.ground("road", b.asphalt, (-BEHIND_M, b.length + 30), (-ROAD_M, ROAD_M), 0.0)
    lines = Assembly("road")
    for s in np.arange(-BEHIND_M, b.length, 5.0):
        x, y, yaw = b.way.at(float(s), 0.0)
        lines.box(b.paint, (x, y, 0.0), (2.4, 0.13, 0.01), yaw=yaw)
    b.groups.append(place_parts(lines, 0.0, np.zeros(3)))
    b.placed.append(Placed((), np.eye(4)))  # lines lie in the outlines of the road


def _side(b: _Layout, side: float, parking: bool, crossing: float | None) -> None:
    """All that lies on one side of the road, with a gap at the side street."""
    kerb = ROAD_M + (PARKING_M if parking else 0.0)
    back = kerb + WALK_M
    gap = () if crossing is None else (crossing - 4.6, crossing + 4.6)
    edges = (-BEHIND_M, *gap, b.length + 30)
    for k in range(0, len(edges), 2):
        s = (edges[k], edges[k + 1])
        if parking:
            b.ground("parking", b.parking, s, _ordered(side, ROAD_M, kerb), 0.02)
        b.ground("sidewalk", b.paving, s, _ordered(side, kerb, back), KERB_M)
        b.ground("terrain", b.grass, s, _ordered(side, back, back + _GARDENS_M), KERB_M + 0.02)
        _gardens(b, side, back, s)
        _furniture(b, side, kerb + 0.35, s)
        _vehicles(b, side, ROAD_M + PARKING_M / 2 if parking else ROAD_M + 0.1, s, parking)


def _ordered(side: float, near: float, far: float) -> tuple[float, float]:
    """Metres to the left, from right to left, so that corners run anticlockwise."""
    return (near, far) if side > 0 else (-far, -near)


def _gardens(b: _Layout, side: float, front: float, along: tuple[float, float]) -> None:
    """Plots with a house, a driveway, and what closes the garden towards the sidewalk."""
    rest = ["hedge", "open"][int(b.rng.integers(2))]
    kinds = [str(k) for k in b.rng.permutation(["wall", "fence", rest])]  # so three plots in a row show them all
    s, number = along[0], 0
    while s < along[1] - 6:
        wide = min(b.between(13, 18), along[1] - s)
        if wide > 10 and s < b.length:
            _plot(b, side, front, (s, s + wide), kinds[number % 3])
        elif s < b.length + 20:
            for _ in range(2):
                _tree(b, s + b.between(0, wide), side * (front + b.between(2, 9)))
        s, number = s + wide, number + 1


def _plot(b: _Layout, side: float, front: float, along: tuple[float, float], kind: str) -> None:
    setback, facing = b.between(3.0, 7.0), 0.0 if side > 0 else np.pi
    drive = along[0] + 0.4 + _DRIVE_M / 2 if b.rng.uniform() < 0.5 else along[1] - 0.4 - _DRIVE_M / 2
    rest = (along[0], drive - _DRIVE_M / 2) if drive > sum(along) / 2 else (drive + _DRIVE_M / 2, along[1])
    if b.rng.uniform() < 0.9:
        home = parts.house(b, rest[1] - rest[0] - b.between(0.6, 2.5), b.pick(b.plaster))
        b.stand(home.assembly, sum(rest) / 2, side * (front + setback), house_outlines(home), turn=facing, z=KERB_M)
    if b.rng.uniform() < 0.75:
        lane = (drive - _DRIVE_M / 2 + 0.2, drive + _DRIVE_M / 2 - 0.2)
        b.ground("parking", b.parking, lane, _ordered(side, front, front + setback + 3.0), KERB_M + 0.05)
        if b.rng.uniform() < 0.6:
            _vehicle(b, drive, side * (front + b.between(3.4, 4.6)), side * np.pi / 2, KERB_M + 0.05)
        if kind != "open" or b.rng.uniform() < 0.3:
            b.along(parts.gate(b, _DRIVE_M, b.gate), drive, side * (front + 0.2), z=KERB_M)
    elif kind != "open":
        rest = along
    _border(b, kind, side * (front + 0.25), rest)
    for _ in range(int(b.rng.integers(0, 3))):
        _tree(b, b.between(*along), side * (front + b.between(1.0, max(setback - 1.0, 1.5))))
    if b.rng.uniform() < 0.4:
        b.along(parts.bins(b), b.between(*rest), side * (front + b.between(0.8, 1.6)), turn=facing, z=KERB_M)
    for _ in range(int(b.rng.integers(1, 4))):  # behind the houses
        _tree(b, b.between(*along), side * (front + setback + b.between(13, 25)))


def _border(b: _Layout, kind: str, left: float, along: tuple[float, float]) -> None:
    piece = 6.0 if b.way.curvature else 40.0
    count = max(int(np.ceil((along[1] - along[0]) / piece)), 1)
    for first, last in _pairs(np.linspace(*along, count + 1)):
        long = (last - first) * (1 - b.way.curvature * left)
        if kind == "wall":
            row = parts.wall(b, long, b.stone)
        elif kind == "fence":
            row = parts.fence(b, long, b.board)
        elif kind == "hedge":
            row = parts.hedge(b, long)
        else:
            return
        b.along(row, (first + last) / 2, left, z=KERB_M)


def _furniture(b: _Layout, side: float, left: float, along: tuple[float, float]) -> None:
    """Lamps, signs, cabinets, bins and small trees along the kerb."""
    s, facing = along[0] + b.between(0, 6), 0.0 if side > 0 else np.pi
    while s < min(along[1] - 1, b.length):
        kind = int(b.rng.choice(5, p=(0.25, 0.25, 0.15, 0.15, 0.2)))
        if kind == 4:
            _tree(b, s, side * (left + 0.3))
        elif kind == 1:
            b.along(parts.signpost(b), s, side * left, turn=0.0 if side < 0 else np.pi, z=KERB_M)
        else:
            thing = (parts.lamp_post, None, parts.cabinet, parts.bins)[kind]
            assert thing is not None
            b.along(thing(b), s, side * left, turn=facing, z=KERB_M)
        s += b.between(4, 10)


def _vehicles(b: _Layout, side: float, left: float, along: tuple[float, float], parking: bool) -> None:
    """What is parked along the kerb: full strips, and a vehicle here and there on the road's edge without one."""
    s = along[0] + 3.5
    while s < min(along[1] - 3, b.length):
        if b.rng.uniform() < (0.72 if parking else 0.2) and (parking or s > 8):
            turn = 0.0 if (b.rng.uniform() < 0.8) == (side < 0) else np.pi
            _vehicle(b, s + b.between(-0.3, 0.3), side * (left + b.between(-0.1, 0.1)), turn + b.between(-0.03, 0.03))
        s += _BAY_M


def _vehicle(b: _Layout, s: float, left: float, turn: float, z: float = 0.02) -> None:
    kind = float(b.rng.uniform())
    if kind < 0.1:
        thing = parts.caravan(b, b.caravan)
    elif kind < 0.24:
        thing = parts.trailer(b, b.trailer)
    else:
        thing = parts.car(b, b.pick(b.lacquers))
    b.along(thing, s, left, turn=turn, z=z)


def _tree(b: _Layout, s: float, left: float) -> None:
    growth = parts.tree(b)
    b.stand(growth, s, left, tree_outlines(growth), z=KERB_M)


def _side_street(b: _Layout, s: float, side: float) -> None:
    """A road away from the way, on which cars are parked, with a house at its far end."""
    near, far = ROAD_M, ROAD_M + PARKING_M + WALK_M + _GARDENS_M
    b.ground("road", b.asphalt, (s - 3.2, s + 3.2), _ordered(side, near, far), 0.0)
    for edge in (-1.0, 1.0):
        strip = sorted((s + edge * 3.2, s + edge * 4.6))
        b.ground("sidewalk", b.paving, (strip[0], strip[1]), _ordered(side, ROAD_M, far), KERB_M)
    for k in range(3):
        if b.rng.uniform() < 0.6:
            _vehicle(b, s + b.between(1.9, 2.2), side * (near + 12.0 + 7.0 * k), side * np.pi / 2)
    home = parts.house(b, 16.0, b.pick(b.plaster))
    b.stand(home.assembly, s, side * far, house_outlines(home), turn=0.0 if side > 0 else np.pi)


def _surroundings(b: _Layout) -> None:
    """A wood and hills that close the street off."""
    end = b.length + 30
    x, y, yaw = b.way.at(end, 0.0)
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    across = np.array([-ahead[1], ahead[0]])
    corners = [np.array([x, y]) + p * ahead + q * across for p, q in ((0, -90), (120, -90), (120, 90), (0, 90))]
    b.slab("terrain", b.grass, tuple((float(c[0]), float(c[1])) for c in corners), 0.0)
    for k in range(_FAR):
        size = b.between(9, 16)
        _clump(b, "vegetation", b.pick(b.leaves[:3]), end + b.between(4, 20), (k - _FAR / 2) * 11.0, (size, size, size))
    for k in range(_FAR):
        size = b.between(60, 110), b.between(60, 110), b.between(16, 44)
        _clump(b, "terrain", b.pick(b.fields), end + b.between(110, 170), (k - _FAR / 2) * 55.0, size)


def _clump(b: _Layout, label: str, material: int, ahead: float, left: float, size: tuple[float, float, float]) -> None:
    """An ellipsoid that stands half in the ground, straight ahead of the street's end."""
    x, y, yaw = b.way.at(b.length + 30, 0.0)
    ahead -= b.length + 30
    solid = Assembly(label)
    at = (
        x + ahead * float(np.cos(yaw)) - left * float(np.sin(yaw)),
        y + ahead * float(np.sin(yaw)) + left * float(np.cos(yaw)),
        0.0,
    )
    solid.ellipsoid(material, at, size)
    T = np.eye(4)
    T[:3, 3] = at
    b.groups.append(place_parts(solid, 0.0, np.zeros(3)))
    b.placed.append(Placed((Outline(label, 0, "ellipsoid", T, np.array(size)),), np.eye(4)))


def _traffic(b: _Layout) -> tuple[Walk, ...]:
    """Two cars: one comes towards the camera, one drives ahead of it, somewhat faster."""
    walks: list[Walk] = []
    for lane, start, step in ((1.7, b.between(34, 44), -0.7), (-1.7, b.between(11, 14), 1.0)):
        b.along(parts.car(b, b.pick(b.lacquers)), start, lane, turn=np.pi if step < 0 else 0.0)
        _, _, yaw = b.way.at(start, lane)
        period = 4000.0  # so long that the sine is its argument
        reach = step * period / (2 * np.pi) * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        walks.append(Walk(len(b.groups) - 1, reach, period, 0.0))
    return tuple(walks)


def _daylight(b: _Layout, scene: Scene) -> Daylight:
    azimuth, elevation = b.between(0, 2 * np.pi), np.radians(b.between(30, 55))
    horizon = display_hsv(0.57, b.between(0.05, 0.2), 0.97)
    zenith = display_hsv(0.6, b.between(0.3, 0.6), b.between(0.75, 0.95))
    x, y, _ = b.way.at(b.length / 2, 0.0)
    sun, T_world_sun = sun_camera(np.array([x, y, 0.0]), azimuth, elevation, _SUN_M)
    focal = _SHADOW_SIZE / 2 * _SUN_M / (b.length / 2 + 35.0)
    shadow = shadow_map(scene.primitives, T_world_sun, focal, _SHADOW_SIZE)
    sky = (horizon, zenith)
    return Daylight("sky", sun, shadow, T_world_sun, focal, _SHADOW_BIAS_M, _SKY_SHADE, sky, clouds(b.rng), _HAZE_M)
