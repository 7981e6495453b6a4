"""What stands along streets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.materials import Pattern
from research.scenes.primitives import Assembly, Shape
from research.scenes.streets.builder import StreetBuilder, SuiteBuilder


@dataclass(frozen=True, slots=True)
class House:
    """A house that stands at y >= 0 of its own axes, with its front at y = 0 and its ridge along x.

    Args:
        assembly: Its parts.
        width, deep: Metres, of its walls.
        eaves, ridge: Heights.
    """

    assembly: Assembly
    width: float
    deep: float
    eaves: float
    ridge: float


def house(b: StreetBuilder, width: float, plaster: int | None = None) -> House:
    """One to three storeys under a gable roof; ``plaster``: material of the walls, None = a new one."""
    storeys = int(b.rng.integers(1, 4))
    height, deep = 0.6 + 2.8 * storeys, b.between(8, 11)
    pattern = (Pattern.PLAIN, Pattern.PLAIN, Pattern.TILES)[int(b.rng.integers(3))]
    hsv = (b.between(0.0, 0.17), b.between(0.03, 0.45), b.between(0.6, 0.95))
    wall = plaster
    if wall is None:
        wall = b.material(pattern, hsv, scale_m=0.3 if pattern == Pattern.TILES else 1.0, dim=0.85)
    roof = b.material(Pattern.STRIPES, (b.between(0.0, 0.06), b.between(0.2, 0.6), b.between(0.3, 0.55)), scale_m=0.3)
    body = Assembly("building")  # y = 0 is its front, the house lies at y > 0
    body.box(wall, (0, deep / 2, height / 2), (width, deep, height))
    pane = b.pick(b.glass)
    door = int(b.rng.integers(max(int(width / 2.6), 1)))
    for storey in range(storeys):
        for k in range(max(int(width / 2.6), 1)):
            at = -width / 2 + 1.4 + 2.6 * k
            if storey == 0 and k == door:
                body.box(b.pick(b.wood), (at, -0.02, 1.15), (1.0, 0.08, 2.1))
                continue
            z = 1.9 + 2.8 * storey
            body.box(b.grey[2], (at, -0.01, z), (1.35, 0.08, 1.55))
            body.box(pane, (at, -0.03, z), (1.15, 0.08, 1.35))
    slope = np.radians(b.between(25, 45))
    reach = deep / 2 / np.cos(slope) + 0.5
    for turn in (1.0, -1.0):  # two slabs lean on each other; the ridge runs along the street
        y, z = deep / 2 - turn * reach / 2 * np.cos(slope), height + reach / 2 * np.sin(slope) - 0.3
        body.box(roof, (0, y, z), (width + 0.4, reach, 0.18), tilt=turn * slope)
    gable = deep / 2 * np.tan(slope) * 0.55
    body.box(wall, (0, deep / 2, height + gable / 2), (width - 0.3, deep * 0.45, gable))
    if b.rng.uniform() < 0.6:
        body.box(
            b.grey[0], (b.between(-width / 3, width / 3), deep / 2, height + reach * np.sin(slope)), (0.6, 0.6, 2.0)
        )
    return House(body, width, deep, height, height + reach * float(np.sin(slope)) - 0.2)


def tree(b: StreetBuilder) -> Assembly:
    """A trunk under a cloud of leaves."""
    growth = Assembly("vegetation")
    trunk, crown = b.between(1.8, 3.0), b.between(2.5, 5.0)
    growth.cylinder(b.wood[0], (0, 0, trunk / 2), (0.3, 0.3, trunk))
    leaf = b.pick(b.leaves)
    for _ in range(6):
        place = (b.between(-0.9, 0.9), b.between(-0.9, 0.9), trunk + b.between(0.2, 0.8) * crown)
        growth.ellipsoid(leaf, place, (crown * 0.6, crown * 0.6, crown * b.between(0.45, 0.7)))
    return growth


def car(b: SuiteBuilder, paint: int) -> Assembly:
    """A hatchback or a saloon; it drives along x."""
    vehicle, long, wide, high = Assembly("car"), b.between(3.8, 4.7), b.between(1.68, 1.82), b.between(1.42, 1.62)
    belt, sill, roof = 0.92, 0.28, high - 0.05
    vehicle.box(paint, (-0.03 * long, 0, (sill + belt) / 2), (0.86 * long, wide, belt - sill))
    vehicle.pillow(paint, (0.36 * long, 0, 0.6), (0.3 * long, wide, 0.62))
    vehicle.pillow(paint, (-0.4 * long, 0, 0.62), (0.22 * long, wide, 0.66))
    rear = b.between(0.25, 0.4) if b.rng.uniform() < 0.6 else b.between(0.6, 0.8)
    cabin = 0.42 * long
    vehicle.box(b.glass[0], (-0.08 * long, 0, (belt + roof) / 2), (cabin, wide - 0.18, roof - belt))
    for x in (-0.5, 0.05, 0.5):  # pillars
        vehicle.box(paint, (-0.08 * long + x * (cabin - 0.08), 0, (belt + roof) / 2), (0.08, wide - 0.16, roof - belt))
    vehicle.box(paint, (-0.08 * long, 0, roof), (cabin + 0.06, wide - 0.2, 0.08))
    for turn, reach in ((-np.pi / 2, 0.62), (np.pi / 2, rear)):  # windscreen and rear window
        start = cabin / 2 + (-0.08 * long if turn < 0 else 0.08 * long)
        vehicle.wedge(b.glass[0], (wide - 0.24, reach, roof - belt), belt, turn, start=start)
    for side in (-1, 1):
        for x in (-0.3, 0.3):
            at = (x * long, side * (wide / 2 - 0.1), 0.31)
            vehicle.add(Shape.CYLINDER, b.rubber, at, (0.62, 0.62, 0.22), tilt=np.pi / 2)
            at = (x * long, side * (wide / 2 + 0.008), 0.31)
            vehicle.add(Shape.CYLINDER, b.grey[1], at, (0.34, 0.34, 0.02), tilt=np.pi / 2)
        vehicle.box(b.grey[2], (0.49 * long, side * 0.3 * wide, 0.68), (0.08, 0.34, 0.16))
        vehicle.box(b.red, (-0.495 * long, side * 0.34 * wide, 0.74), (0.06, 0.26, 0.16))
    vehicle.box(b.rubber, (0.5 * long, 0, 0.38), (0.06, 1.2, 0.16))
    vehicle.box(b.grey[2], (-0.508 * long, 0, 0.5), (0.02, 0.52, 0.12))
    return vehicle


def caravan(b: SuiteBuilder, paint: int) -> Assembly:
    """A caravan on one axle; its drawbar points along x."""
    vehicle, long, high = Assembly("caravan"), b.between(4.2, 5.6), b.between(2.45, 2.65)
    middle, tall = (0.42 + high) / 2, high - 0.42
    vehicle.box(paint, (0, 0, middle), (long * 0.84, 2.15, tall))
    for end in (-1, 1):
        vehicle.pillow(paint, (end * 0.4 * long, 0, middle - 0.04), (0.2 * long, 2.13, tall - 0.08))
    for side in (-1, 1):
        for x in (-0.2, 0.22):
            vehicle.box(b.glass[0], (x * long, side * 1.07, 1.62), (0.24 * long, 0.06, 0.56))
        vehicle.box(b.red, (0, side * 1.075, 0.95), (long * 0.8, 0.02, 0.1))
        vehicle.add(Shape.CYLINDER, b.rubber, (-0.15, side * 0.98, 0.32), (0.64, 0.64, 0.22), tilt=np.pi / 2)
    vehicle.box(b.glass[0], (-0.49 * long, 0, 1.7), (0.08, 1.3, 0.5))
    vehicle.box(b.grey[1], (0.55 * long, 0, 0.45), (0.24 * long, 0.12, 0.1))
    vehicle.cylinder(b.rubber, (0.62 * long, 0, 0.22), (0.2, 0.2, 0.44))
    return vehicle


def trailer(b: SuiteBuilder, paint: int) -> Assembly:
    """A car's trailer with boards or a box; its drawbar points along x."""
    vehicle, long = Assembly("trailer"), b.between(2.5, 3.4)
    if b.rng.uniform() < 0.4:
        high = b.between(1.4, 1.9)
        vehicle.box(paint, (0, 0, 0.5 + high / 2), (long, 1.6, high))
    else:
        for side in (-1, 1):
            vehicle.box(paint, (0, side * 0.78, 0.75), (long, 0.05, 0.5))
            vehicle.box(paint, (side * long / 2, 0, 0.75), (0.05, 1.6, 0.5))
        vehicle.box(b.wood[0], (0, 0, 0.53), (long, 1.55, 0.06))
        if b.rng.uniform() < 0.6:
            vehicle.pillow(b.pick(b.paints), (0, 0, 1.0), (long * 0.98, 1.6, b.between(0.3, 0.7)))
    for side in (-1, 1):
        vehicle.add(Shape.CYLINDER, b.rubber, (-0.1, side * 0.9, 0.3), (0.6, 0.6, 0.2), tilt=np.pi / 2)
        vehicle.box(b.red, (-long / 2 - 0.03, side * 0.6, 0.52), (0.05, 0.25, 0.14))
    vehicle.box(b.grey[1], (long / 2 + 0.55, 0, 0.45), (1.2, 0.1, 0.1))
    return vehicle


def bins(b: SuiteBuilder) -> Assembly:
    """One to three bins with lids, of the class box."""
    row = Assembly("box")
    for k in range(int(b.rng.integers(1, 4))):
        row.box(b.pick(b.paints), (0.7 * k, 0, 0.5), (0.56, 0.62, 1.0))
        row.box(b.grey[0], (0.7 * k, 0, 1.03), (0.6, 0.68, 0.08))
    return row


def cabinet(b: SuiteBuilder) -> Assembly:
    """A cabinet of the power or telephone company, or a container for glass."""
    thing, paint = Assembly("box"), b.pick([*b.grey[1:], *b.paints])
    wide, high = b.between(0.9, 1.8), b.between(1.0, 1.6)
    thing.box(paint, (0, 0, high / 2), (wide, 0.5, high))
    thing.box(b.grey[0], (0, 0, high + 0.03), (wide + 0.08, 0.58, 0.06))
    thing.box(b.grey[0], (0, -0.26, high / 2), (0.03, 0.02, high * 0.9))
    return thing


def lamp_post(b: SuiteBuilder) -> Assembly:
    """A post whose arm reaches over the street (own -y)."""
    post, high = Assembly("pole"), b.between(4.8, 6.5)
    post.cylinder(b.grey[0], (0, 0, high / 2), (0.14, 0.14, high))
    post.box(b.grey[0], (0, -0.55, high), (0.09, 1.2, 0.09))
    post.box(b.grey[2], (0, -1.1, high - 0.06), (0.22, 0.55, 0.12))
    return post


def signpost(b: SuiteBuilder) -> Assembly:
    """A traffic sign on a thin pole, facing own -x; the sign is an object of its own."""
    post = Assembly("pole")
    post.cylinder(b.grey[1], (0, 0, 1.25), (0.08, 0.08, 2.5))
    turn = {"yaw": np.pi / 2, "tilt": np.pi / 2, "label": "sign", "item": 1}
    rim, face = (b.red, b.grey[2]) if b.rng.uniform() < 0.6 else (b.pick(b.paints), b.grey[2])
    if b.rng.uniform() < 0.6:  # a disc
        post.add(Shape.CYLINDER, rim, (-0.06, 0, 2.5), (0.66, 0.66, 0.04), **turn)  # type: ignore[arg-type]
        post.add(Shape.CYLINDER, face, (-0.085, 0, 2.5), (0.46, 0.46, 0.03), **turn)  # type: ignore[arg-type]
    else:
        post.box(rim, (-0.06, 0, 2.5), (0.04, 0.62, 0.62), label="sign", item=1)
        post.box(face, (-0.085, 0, 2.5), (0.03, 0.3, 0.3), label="sign", item=1)
    return post


def hedge(b: SuiteBuilder, long: float) -> Assembly:
    """A hedge along x, with leaves that stand out."""
    row, high, leaf = Assembly("vegetation"), b.between(0.8, 1.7), b.pick(b.leaves)
    row.box(leaf, (0, 0, high * 0.45), (long, 0.6, high * 0.9))
    for k in range(int(long / 0.9)):
        x = -long / 2 + 0.45 + 0.9 * k
        size = (b.between(0.9, 1.4), b.between(0.6, 0.9), b.between(0.4, 0.7))
        row.ellipsoid(leaf, (x, b.between(-0.08, 0.08), high * b.between(0.7, 0.92)), size)
    return row


def fence(b: SuiteBuilder, long: float, board: int) -> Assembly:
    """Upright slats on two rails, along x."""
    row, high, pitch = Assembly("fence"), b.between(0.8, 1.5), b.between(0.16, 0.26)
    for k in range(int(long / pitch)):
        row.box(board, (-long / 2 + pitch * (k + 0.5), 0, high / 2), (0.62 * pitch, 0.03, high))
    for z in (0.25, 0.8):
        row.box(board, (0, 0.03, high * z), (long, 0.04, 0.08))
    return row


def wall(b: SuiteBuilder, long: float, stone: int) -> Assembly:
    """A garden wall under a coping, along x."""
    row, high = Assembly("wall"), b.between(0.7, 1.6)
    row.box(stone, (0, 0, high / 2), (long, 0.24, high))
    row.box(b.grey[1], (0, 0, high + 0.03), (long + 0.04, 0.32, 0.06))
    return row


def gate(b: SuiteBuilder, long: float, board: int) -> Assembly:
    """Two leaves between posts, along x."""
    both, high = Assembly("gate"), b.between(1.0, 1.6)
    solid = b.rng.uniform() < 0.4
    for side in (-1, 1):
        both.box(b.grey[0], (side * (long / 2 - 0.06), 0, high / 2 + 0.06), (0.14, 0.14, high + 0.12))
        leaf = long / 2 - 0.16
        middle = side * (leaf / 2 + 0.02)
        if solid:
            both.box(board, (middle, 0, high / 2 + 0.04), (leaf, 0.05, high - 0.1))
            continue
        for z in (0.12, high * 0.9):
            both.box(board, (middle, 0, z), (leaf, 0.05, 0.09))
        for k in range(int(leaf / 0.15)):
            both.box(board, (middle - leaf / 2 + 0.15 * (k + 0.5), 0, high / 2), (0.055, 0.04, high * 0.95))
    return both
