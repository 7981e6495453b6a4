"""Ground, river, streets and bridges of a town, and what stands and drives on its streets."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from research.scenes.aerial import parts
from research.scenes.aerial.builder import KERB_M, ROAD_M, WALK_M, TownBuilder
from research.scenes.aerial.parts import LANE_M, LINE_M, PARKED_M, ZEBRAS, along
from research.scenes.aerial.plan import DECK_M, RIVER_M, TownPlan
from research.scenes.primitives import Assembly

_FAR_M = 700.0  # where the land ends
_WATER_M = -1.6
_STREET_TOP_M = 0.04
_LINE_TOP_M = 0.05
_BRIDGE_CARS = 0.42  # as many as streets have, buses and trucks counted in
_UNLINED_M = 7.5  # at the foot of a ramp


def lay_ground(b: TownBuilder, plan: TownPlan) -> None:
    """Land on both sides of the river, walls along it, and fields round the town."""
    edge = RIVER_M + 0.5
    land = Assembly("terrain")
    for side in (-1, 1):
        deep = _FAR_M - side * plan.river_y - edge
        land.box(b.grass, (0, plan.river_y + side * (edge + deep / 2), -2.0), (2 * _FAR_M, deep, 4.0))
    b.place(land, 0, 0)
    river = Assembly("water")
    river.box(b.water, (0, 0, _WATER_M - 0.5), (2 * _FAR_M, 2 * edge, 1.0))
    b.place(river, 0, plan.river_y)
    for side in (-1, 1):
        quay = Assembly("wall")
        quay.box(b.brick, (0, 0, -0.6), (2 * plan.xs[-1] + 12.0, 0.8, 3.2))
        b.place(quay, 0, plan.river_y + side * RIVER_M)
    _surroundings(b, plan)


def lay_streets(b: TownBuilder, plan: TownPlan) -> None:
    """Asphalt, sidewalks of blocks and quays, lines and zebra crossings."""
    roads, lines, walks = Assembly("roads"), Assembly("roadline"), Assembly("sidewalks")
    x0, x1, y0, y1 = plan.xs[0], plan.xs[-1], plan.ys[0], plan.ys[-1]
    for k, y in enumerate(plan.ys):
        long = _FAR_M if k == 0 else x1 + ROAD_M
        roads.box(b.asphalt, (0, y, _STREET_TOP_M - 0.3), (2 * long, 2 * ROAD_M, 0.6))
    south, north = (y0, plan.ys[plan.river]), (plan.ys[plan.river + 1], y1)
    for x in plan.xs:
        for low, high in (south, north):
            if high > low:
                roads.box(b.asphalt, (x, (low + high) / 2, _STREET_TOP_M - 0.3), (2 * ROAD_M, high - low, 0.6))
    for x, y, along_x, long in segments(plan):
        size = (long - 6.0, LINE_M) if along_x else (LINE_M, long - 6.0)
        lines.box(b.paint, (x, y, _LINE_TOP_M - 0.05), (*size, 0.1))
        if b.often(ZEBRAS):
            at = (long / 2 - 1.6) * (1 if b.often(0.5) else -1)
            middle = (x + at, y) if along_x else (x, y + at)
            lines.box(b.zebra, (*middle, _LINE_TOP_M - 0.05), (3.0, 2 * ROAD_M - 1, 0.11) if along_x else _turned())
    for row in plan.block_rows():
        for column in range(len(plan.xs) - 1):
            block = plan.block(column, row)
            walks.box(b.walk, (*block.middle, KERB_M - 0.25), (*block.size, 0.5))
    for bank in (-1, 1):
        y = plan.ys[plan.river] if bank < 0 else plan.ys[plan.river + 1]
        walks.box(b.walk, (0, y - bank * (ROAD_M + WALK_M / 2), KERB_M - 0.25), (x1 - x0, WALK_M, 0.5))
    _outer_walks(b, plan, walks)
    for assembly in (roads, lines, walks):
        b.place(assembly, 0, 0)


def _outer_walks(b: TownBuilder, plan: TownPlan, walks: Assembly) -> None:
    """Sidewalks on the far sides of the outermost streets."""
    x0, x1, y0, y1 = plan.xs[0], plan.xs[-1], plan.ys[0], plan.ys[-1]
    aside, z = ROAD_M + WALK_M / 2, KERB_M - 0.25
    banks = (y0 + ROAD_M, plan.ys[plan.river] + ROAD_M), (plan.ys[plan.river + 1] - ROAD_M, y1 + ROAD_M)
    for side, x, y in ((-1, x0, y0), (1, x1, y1)):
        walks.box(b.walk, (0, y + side * aside, z), (x1 - x0 + 2 * ROAD_M, WALK_M, 0.5))
        for low, high in banks:
            walks.box(b.walk, (x + side * aside, (low + high) / 2, z), (WALK_M, high - low, 0.5))


def build_bridges(b: TownBuilder, plan: TownPlan) -> None:
    """Decks of the streets' asphalt with their lines, walks, cars and lamps, ramps down to the streets, and piers."""
    foot = (plan.ys[plan.river + 1] - plan.ys[plan.river]) / 2 - ROAD_M  # from the middle of the river
    flat = RIVER_M + 1.0
    ramp, wide = foot - flat, 2 * (ROAD_M + WALK_M)
    slope, slant = float(np.arctan2(DECK_M, ramp)), float(np.hypot(DECK_M, ramp))
    for number in plan.bridges:
        bridge, here = Assembly("bridge"), (plan.xs[number], plan.river_y)
        bridge.box(b.asphalt, (0, 0, DECK_M - 0.5), (2 * ROAD_M, 2 * flat, 1.0))
        bridge.box(b.paint, (0, 0, DECK_M), (LINE_M, 2 * flat, 0.04), label="roadline")
        parts.cars_on(b, here, np.pi / 2, 2 * flat, DECK_M + 0.02, often=_BRIDGE_CARS)
        for end in (-1, 1):
            bridge.wedge(b.asphalt, (2 * ROAD_M, ramp, DECK_M), 0.0, 0.0 if end > 0 else np.pi, start=flat)
            middle, tilt = end * (flat + ramp / 2), -end * slope
            share = 1 - _UNLINED_M / slant  # of the ramp that has a line, from the deck on
            at = (0, end * (flat + share * ramp / 2), DECK_M * (1 - share / 2) + 0.02)
            bridge.box(b.paint, at, (LINE_M, share * slant, 0.04), label="roadline", tilt=tilt)
            if b.often(2 * ZEBRAS):
                low = (0, end * (foot - 1.8), DECK_M * 1.8 / ramp + 0.02)
                bridge.box(b.zebra, low, (2 * ROAD_M - 1, 3.0, 0.06), label="roadline", tilt=tilt)
            place, z = (here[0], here[1] + middle), DECK_M / 2 + 0.02
            parts.cars_on(b, place, np.pi / 2, slant - 3.0, z, often=_BRIDGE_CARS, tilt=tilt)
            for side in (-1, 1):
                x = side * (ROAD_M + WALK_M / 2)
                bridge.box(b.walk, (x, middle, DECK_M / 2 + KERB_M - 0.5), (WALK_M, slant, 1.0), tilt=tilt)
                rail = (side * wide / 2, middle, DECK_M / 2 + 0.4)
                bridge.box(b.walk, rail, (0.3, slant, 1.6), tilt=tilt)
        for side in (-1, 1):
            x = side * (ROAD_M + WALK_M / 2)
            bridge.box(b.walk, (x, 0, DECK_M + KERB_M - 0.5), (WALK_M, 2 * flat, 1.0))
            bridge.box(b.walk, (side * wide / 2, 0, DECK_M + 0.4), (0.3, 2 * flat, 1.6))
            bridge.box(b.metal[2], (0, side * RIVER_M * 0.45, DECK_M / 2 - 1.5), (wide - 3, 1.6, DECK_M + 1))
            for at in (-0.6, 0.25):
                aside, ahead = side * (ROAD_M + 0.5), side * at * foot
                z = DECK_M * min(1.0, (foot - abs(ahead)) / ramp)
                parts.street_lamp(b, *along(*here, np.pi / 2, ahead, aside), np.pi / 2 - side * np.pi / 2, z=z)
        b.place(bridge, *here)


def fill_streets(b: TownBuilder, plan: TownPlan, lacking: frozenset[str]) -> None:
    """Vehicles, lamps, lights, signs and people along all streets."""
    for x, y, along_x, long in segments(plan):
        yaw = 0.0 if along_x else np.pi / 2
        for side in (-1, 1):
            _vehicles(b, (x, y), yaw, side, long, lacking)
            at, aside = b.between(-0.3, 0.3) * long, side * (ROAD_M + 0.5)
            parts.street_lamp(b, *along(x, y, yaw, at, aside), yaw - side * np.pi / 2)
            if "pedestrian" not in lacking:
                for _ in range(int(b.rng.integers(0, 3) * b.crowd + 0.5)):
                    parts.person(b, *along(x, y, yaw, b.between(-0.4, 0.4) * long, side * (ROAD_M + 1.6)))
        corner = along(x, y, yaw, long / 2 - 1.5, -(ROAD_M + 0.6))
        if "trafficlight" not in lacking and b.often(0.3):
            parts.traffic_light(b, *corner, yaw + np.pi / 2)
        elif "trafficsign" not in lacking and b.often(0.35):
            parts.traffic_sign(b, *corner, yaw)


def segments(plan: TownPlan) -> Iterator[tuple[float, float, bool, float]]:
    """Streets from junction to junction: middle (x, y), whether along x, and length without the junctions."""
    for y in plan.ys:
        for x0, x1 in zip(plan.xs[:-1], plan.xs[1:], strict=True):
            yield (x0 + x1) / 2, y, True, x1 - x0 - 2 * ROAD_M
    for x in plan.xs:
        for row in plan.block_rows():
            y0, y1 = plan.ys[row], plan.ys[row + 1]
            yield x, (y0 + y1) / 2, False, y1 - y0 - 2 * ROAD_M


def _surroundings(b: TownBuilder, plan: TownPlan) -> None:
    """Fields, and clumps of trees on them."""
    field, clump = Assembly("terrain"), Assembly("vegetation")
    for k in range(14):
        far, angle = plan.reach_m * b.between(1.5, 3.0), b.between(0, 2 * np.pi)
        x, y, size = far * float(np.cos(angle)), far * float(np.sin(angle)), b.between(40, 90)
        if abs(y - plan.river_y) > RIVER_M + size and max(abs(x), abs(y)) > plan.reach_m + size * 0.75:
            place, sides = (x, y, -0.1 + 0.001 * k), (size, size * b.between(0.5, 0.9), 0.24)
            field.box(b.pick(b.crops), place, sides, yaw=b.between(-0.2, 0.2))
    for _ in range(28):
        far, angle = plan.reach_m * b.between(1.2, 2.4), b.between(0, 2 * np.pi)
        x, y, leaf = far * float(np.cos(angle)), far * float(np.sin(angle)), b.pick(b.leaves)
        if abs(y - plan.river_y) > RIVER_M + 14 and not _on_long_street(plan, y, 12.0):
            for _ in range(3):
                size = b.between(5, 10)
                place = (x + b.between(-6, 6), y + b.between(-6, 6), size * 0.35)
                clump.ellipsoid(leaf, place, (size, size, size))
    if field.parts:
        b.place(field, 0, 0)
    b.place(clump, 0, 0)


def _vehicles(
    b: TownBuilder, place: tuple[float, float], yaw: float, side: int, long: float, lacking: frozenset[str]
) -> None:
    large = [name for name in ("bus", "truck") if name not in lacking]
    if large and b.often(0.24 * b.crowd):
        build = parts.bus if large[int(b.rng.integers(len(large)))] == "bus" else parts.truck
        build(b, *along(*place, yaw, b.between(-0.2, 0.2) * long, -side * LANE_M), yaw + (side < 0) * np.pi)
    elif b.often(0.5 * b.crowd):
        parts.car(b, *along(*place, yaw, b.between(-0.4, 0.4) * long, -side * LANE_M), yaw)
    for at in np.arange(-long / 2 + 6.5, long / 2 - 5, 6.0):
        if b.often(0.24 * b.crowd):
            parts.car(b, *along(*place, yaw, float(at) + b.between(-0.4, 0.4), side * PARKED_M), yaw)


def _turned() -> tuple[float, float, float]:
    return 2 * ROAD_M - 1, 3.0, 0.11


def _on_long_street(plan: TownPlan, y: float, size: float) -> bool:
    return abs(y - plan.ys[0]) < ROAD_M + size
