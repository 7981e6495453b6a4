"""What stands in a town: buildings, trees, vehicles, people and what lines its streets."""

from __future__ import annotations

import numpy as np

from semantic_mapper.scenes.aerial.builder import KERB_M, STOREY_M, TownBuilder
from semantic_mapper.scenes.primitives import Assembly

_PARAPET_M = 0.7
_EDGE_M = 1.6  # paved, along a parapet
_GABLE_M = 0.35  # by which a roof stands out


def flat_building(b: TownBuilder, x: float, y: float, wide: float, deep: float, storeys: int) -> None:
    """A block under a roof of asphalt with white seams and machines; along the parapet it is paved as sidewalks are."""
    house, wall, walk, high = Assembly("building"), b.pick(b.walls), b.walk(), STOREY_M * storeys
    house.box(wall, (0, 0, high / 2), (wide, deep, high))
    house.box(walk, (0, 0, high + 0.05), (wide - 0.4, deep - 0.4, 0.1))
    house.box(b.asphalt, (0, 0, high + 0.1), (wide - 2 * _EDGE_M, deep - 2 * _EDGE_M, 0.2))
    for side in (-1, 1):
        house.box(walk, (side * (wide - 0.4) / 2, 0, high + _PARAPET_M / 2), (0.4, deep, _PARAPET_M))
        house.box(walk, (0, side * (deep - 0.4) / 2, high + _PARAPET_M / 2), (wide, 0.4, _PARAPET_M))
    for _ in range(2):  # seams as wide as the lines on the streets
        if b.often(0.5):
            house.box(b.paint, (b.between(-0.3, 0.3) * wide, 0, high + 0.2), (0.35, deep - 2 * _EDGE_M, 0.04))
        else:
            house.box(b.paint, (0, b.between(-0.3, 0.3) * deep, high + 0.2), (wide - 2 * _EDGE_M, 0.35, 0.04))
    for _ in range(int(b.rng.integers(1, 4))):
        size = (b.between(1.2, 3.5), b.between(1.2, 3.0), b.between(1.0, 2.6))
        place = (b.between(-0.35, 0.35) * wide, b.between(-0.35, 0.35) * deep, high + 0.2 + size[2] / 2)
        house.box(b.pick([*b.metal, *b.lacquers]), place, size)
    b.place(house, x, y, z=KERB_M)


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


def car(b: TownBuilder, x: float, y: float, yaw: float, *, z: float = 0.05) -> None:
    """Body, windows and roof of a car."""
    vehicle, paint = Assembly("car"), b.pick(b.lacquers)
    long, high = b.between(4.0, 4.8), b.between(1.4, 1.7)
    vehicle.pillow(paint, (0, 0, 0.58), (long, 1.85, 0.95))
    vehicle.pillow(b.glass, (-0.15, 0, high - 0.35), (long * 0.58, 1.65, 0.8))
    vehicle.box(paint, (-0.2, 0, high - 0.02), (long * 0.33, 1.35, 0.1))
    b.place(vehicle, x, y, z=z, yaw=yaw)


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


def street_lamp(b: TownBuilder, x: float, y: float, yaw: float) -> None:
    """A post with an arm over the street (own x)."""
    post = Assembly("pole")
    post.cylinder(b.metal[0], (0, 0, 3.5), (0.3, 0.3, 7.0))
    post.box(b.metal[0], (1.0, 0, 7.0), (2.2, 0.3, 0.25))
    b.place(post, x, y, yaw=yaw)


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
