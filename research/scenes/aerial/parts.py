"""What stands in a town: buildings, trees, vehicles, people and what lines its streets."""

from __future__ import annotations

import numpy as np

from research.scenes.aerial.builder import KERB_M, ROAD_M, STOREY_M, WALK_M, TownBuilder
from research.scenes.primitives import Assembly

_PARAPET_M = 0.7
_LINED = 0.65  # of a lane's length
_PITCH_M = 42.0  # from junction to junction, about
LINE_M = 0.35  # width of a line
LANE_M = 1.8  # middle of a lane off the middle of a street
PARKED_M = 3.4  # middle of a parked car
ZEBRAS = 0.45  # crossings between two junctions
_DECK_CARS = 0.33  # on flat roofs; more than on streets, as their rows are short
_GABLE_M = 0.35  # by which a roof stands out


def flat_building(b: TownBuilder, x: float, y: float, wide: float, deep: float, storeys: int) -> None:
    """A block under a deck for cars, which is made like the streets: asphalt between walks, lines, lamps."""
    house, wall, high = Assembly("building"), b.pick(b.walls), STOREY_M * storeys
    top = high + 0.2
    house.box(wall, (0, 0, high / 2), (wide, deep, high))
    house.box(b.walk, (0, 0, high + 0.05), (wide - 0.4, deep - 0.4, 0.1))
    inner = wide - 2 * WALK_M, deep - 2 * WALK_M
    house.box(b.asphalt, (0, 0, high + 0.1), (*inner, 0.2))
    for side in (-1, 1):
        house.box(b.walk, (side * (wide - 0.4) / 2, 0, high + _PARAPET_M / 2), (0.4, deep, _PARAPET_M))
        house.box(b.walk, (0, side * (deep - 0.4) / 2, high + _PARAPET_M / 2), (wide, 0.4, _PARAPET_M))
    yaw = 0.0 if inner[0] > inner[1] else np.pi / 2  # of the lanes
    long, across = max(inner), min(inner)
    lanes = round(across / (2 * ROAD_M))
    for k in range(lanes):
        aside = ((k + 0.5) / lanes - 0.5) * across
        house.box(b.paint, (*along(0, 0, yaw, 0, aside), high + 0.2), (_LINED * long, LINE_M, 0.04), yaw=yaw)
        if b.often(2 * ZEBRAS * long / _PITCH_M):
            size = (3.0, across / lanes - 1, 0.04)
            house.box(b.zebra, (*along(0, 0, yaw, long / 2 - 1.6, aside), high + 0.2), size, yaw=yaw)
        cars_on(b, along(x, y, yaw, 0, aside), yaw, long, top + KERB_M, wide=across / lanes, often=_DECK_CARS)
        if b.often(3 * long / _PITCH_M):
            side = -1 if k == 0 else 1
            at = b.between(-0.3, 0.3) * long, side * (across / 2 + 0.5)
            street_lamp(b, *along(x, y, yaw, *at), yaw - side * np.pi / 2, z=top + KERB_M)
    b.place(house, x, y, z=KERB_M)


def cars_on(
    b: TownBuilder,
    place: tuple[float, float],
    yaw: float,
    long: float,
    z: float,
    *,
    often: float,
    wide: float = 2 * ROAD_M,
    tilt: float = 0.0,
) -> None:
    """Cars on a stretch of asphalt that is not a street.

    Args:
        b: Of the town.
        place: Middle of the stretch.
        yaw: Along which it runs.
        long: Its length in metres, along the slope.
        z: Height of the asphalt in its middle.
        often: Probability that a place is taken, every 6 m on either side, where ``crowd`` is 1.
        wide: Its width in metres.
        tilt: By which a stretch along y is turned about x.
    """
    for at in np.arange(-long / 2 + 3, long / 2 - 2.9, 6.0):
        for side in (-1, 1):
            if b.often(often * b.crowd):
                ahead = float(at) + b.between(-0.4, 0.4)
                aside = side * min(LANE_M if b.often(0.4) else PARKED_M, wide / 2 - 1.1)
                x, y = along(*place, yaw, ahead * float(np.cos(tilt)), aside)
                car(b, x, y, yaw, z=z + ahead * float(np.sin(tilt)), tilt=tilt)


def along(x: float, y: float, yaw: float, ahead: float, left: float) -> tuple[float, float]:
    """A place seen from (x, y), looking along ``yaw``."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return x + c * ahead - s * left, y + s * ahead + c * left


def gabled_house(b: TownBuilder, x: float, y: float, wide: float, deep: float, yaw: float) -> None:
    """A house whose ridge runs along its own x axis."""
    house, wall, high = Assembly("building"), b.pick(b.plaster), STOREY_M * int(b.rng.integers(1, 3))
    roof, rise = b.pick(b.roofs), deep / 2 * b.between(0.55, 0.9)
    house.box(wall, (0, 0, high / 2), (wide, deep, high))
    half = deep / 2 + _GABLE_M
    for turn in (0.0, np.pi):  # two wedges stand back to back
        house.wedge(roof, (wide + 2 * _GABLE_M, half, rise), high, turn)
    if b.often(0.7):
        house.box(b.brick, (b.between(-0.3, 0.3) * wide, 0.15 * deep, high + rise), (0.8, 0.8, 2.0))
    if b.often(0.4):
        house.box(b.pick([b.wood, wall]), (wide / 2 + 1.6, -deep / 5, 1.3), (3.2, deep * 0.5, 2.6))
    b.place(house, x, y, z=KERB_M, yaw=yaw)


def tree(b: TownBuilder, x: float, y: float, *, z: float = KERB_M) -> None:
    """A trunk under three clouds of leaves."""
    growth, trunk, crown = Assembly("vegetation"), b.between(1.6, 3.0), b.between(3.0, 6.0)
    growth.cylinder(b.wood, (0, 0, trunk / 2), (0.4, 0.4, trunk))
    leaf = b.pick(b.leaves)
    for _ in range(3):
        place = (b.between(-0.22, 0.22) * crown, b.between(-0.22, 0.22) * crown, trunk + b.between(0.25, 0.6) * crown)
        growth.ellipsoid(leaf, place, (crown * b.between(0.65, 0.9), crown * b.between(0.65, 0.9), crown * 0.75))
    b.place(growth, x, y, z=z)


def car(b: TownBuilder, x: float, y: float, yaw: float, *, z: float = 0.05, tilt: float = 0.0) -> None:
    """Body, windows and roof of a car."""
    vehicle, paint = Assembly("car"), b.pick(b.lacquers)
    long, high = b.between(4.0, 4.8), b.between(1.4, 1.7)
    vehicle.pillow(paint, (0, 0, 0.58), (long, 1.85, 0.95))
    vehicle.pillow(b.glass, (-0.15, 0, high - 0.35), (long * 0.58, 1.65, 0.8))
    vehicle.box(paint, (-0.2, 0, high - 0.02), (long * 0.33, 1.35, 0.1))
    b.place(vehicle, x, y, z=z, yaw=yaw, tilt=tilt)


def bus(b: TownBuilder, x: float, y: float, yaw: float) -> None:
    """A city bus."""
    vehicle, paint = Assembly("bus"), b.pick(b.lacquers[:5])
    vehicle.box(paint, (0, 0, 1.05), (11.8, 2.5, 1.3))
    vehicle.box(b.glass, (0, 0, 2.1), (11.7, 2.45, 0.9))
    vehicle.box(b.pick([paint, b.lacquers[8]]), (0, 0, 2.75), (11.8, 2.5, 0.45))
    vehicle.box(b.metal[1], (b.between(-2, 2), 0, 3.1), (2.6, 1.6, 0.35))
    b.place(vehicle, x, y, yaw=yaw)


def truck(b: TownBuilder, x: float, y: float, yaw: float) -> None:
    """A cab, and a box behind it."""
    vehicle = Assembly("truck")
    vehicle.box(b.pick(b.lacquers), (3.1, 0, 1.5), (1.9, 2.3, 2.2))
    vehicle.box(b.glass, (4.0, 0, 1.95), (0.25, 2.1, 0.9))
    vehicle.box(b.pick(b.lacquers), (-0.9, 0, 2.0), (5.6, 2.45, 2.7))
    vehicle.box(b.metal[0], (0, 0, 0.5), (7.6, 2.0, 0.5))
    b.place(vehicle, x, y, yaw=yaw)


def person(b: TownBuilder, x: float, y: float) -> None:
    """Somebody who stands."""
    figure = Assembly("pedestrian")
    figure.cylinder(b.pick(b.lacquers), (0, 0, 0.45), (0.5, 0.4, 0.9))
    figure.ellipsoid(b.pick(b.lacquers), (0, 0, 1.15), (0.75, 0.5, 1.0))
    b.place(figure, x, y, z=KERB_M, yaw=b.between(0, np.pi))


def street_lamp(b: TownBuilder, x: float, y: float, yaw: float, *, z: float = 0.0) -> None:
    """A post with an arm over the street (own x)."""
    post = Assembly("pole")
    post.cylinder(b.metal[0], (0, 0, 3.5), (0.3, 0.3, 7.0))
    post.box(b.metal[0], (1.0, 0, 7.0), (2.2, 0.3, 0.25))
    b.place(post, x, y, z=z, yaw=yaw)


def traffic_light(b: TownBuilder, x: float, y: float, yaw: float) -> None:
    """A post with an arm over the street (own x) that carries two boxes of lights."""
    post = Assembly("pole")
    post.cylinder(b.metal[0], (0, 0, 2.9), (0.3, 0.3, 5.8))
    post.box(b.metal[0], (2.2, 0, 5.6), (4.4, 0.25, 0.25))
    for at in (0.3, 4.2):
        post.box(b.glass, (at, 0, 5.0), (0.6, 0.6, 1.5), label="trafficlight")
    b.place(post, x, y, yaw=yaw)


def traffic_sign(b: TownBuilder, x: float, y: float, yaw: float) -> None:
    """A board on two posts."""
    board = Assembly("trafficsign")
    for side in (-1.1, 1.1):
        board.cylinder(b.metal[0], (0, side, 1.2), (0.2, 0.2, 2.4), label="pole")
    board.box(b.pick(b.lacquers), (0, 0, 2.8), (0.25, 3.2, 1.8))
    b.place(board, x, y, yaw=yaw)


def static_thing(b: TownBuilder, x: float, y: float, yaw: float) -> None:
    """What is bolted down: a bus shelter, a kiosk or a skip."""
    thing, kind = Assembly("static"), int(b.rng.integers(3))
    if kind == 0:
        thing.box(b.metal[2], (0, 0, 2.5), (4.5, 1.8, 0.15))
        thing.box(b.glass, (0, -0.8, 1.2), (4.3, 0.12, 2.4))
    elif kind == 1:
        thing.box(b.container, (0, 0, 1.3), (3.0, 2.4, 2.6))
        thing.box(b.metal[1], (0, 0, 2.7), (3.5, 2.9, 0.2))
    else:
        thing.box(b.container, (0, 0, 0.75), (3.6, 1.9, 1.5))
    b.place(thing, x, y, z=KERB_M, yaw=yaw)


def dynamic_thing(b: TownBuilder, x: float, y: float) -> None:
    """What may be elsewhere tomorrow: bins on wheels, or a parasol over a table."""
    thing = Assembly("dynamic")
    if b.often(0.5):
        for k in range(3):
            thing.box(b.pick(b.lacquers), (0.95 * k, 0, 0.6), (0.85, 0.9, 1.2))
    else:
        thing.cylinder(b.wood, (0, 0, 0.8), (1.4, 1.4, 0.12))
        thing.frustum(b.pick(b.lacquers), (0, 0, 2.4), (3.0, 3.0, 0.6))
    b.place(thing, x, y, z=KERB_M, yaw=b.between(0, np.pi))


def border(b: TownBuilder, label: str, x: float, y: float, long: float, yaw: float) -> None:
    """A fence, a wall, or a hedge ("vegetation") along own x."""
    line = Assembly(label)
    if label == "fence":
        line.box(b.wood, (0, 0, 0.7), (long, 0.2, 1.4))
    elif label == "wall":
        line.box(b.brick, (0, 0, 0.9), (long, 0.45, 1.8))
    else:
        line.box(b.pick(b.leaves), (0, 0, 0.7), (long, 0.9, 1.4))
    b.place(line, x, y, z=KERB_M, yaw=yaw)
