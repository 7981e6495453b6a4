"""What fills blocks and quays: houses with gardens, offices, parks, squares and car parks."""

from __future__ import annotations

import numpy as np

from research.scenes.aerial import parts
from research.scenes.aerial.builder import KERB_M, WALK_M, TownBuilder
from research.scenes.aerial.plan import Rectangle, TownPlan
from research.scenes.primitives import Assembly

_FLOOR_M = KERB_M + 0.02
_STALL_M, _STALL_LONG_M, _LANE_M = 2.6, 5.0, 6.0
_MOST_CARS = 60
_DIVIDED_M = 33.5  # width from which a block has two flat roofs


def fill_blocks(b: TownBuilder, plan: TownPlan, lacking: frozenset[str]) -> None:
    """Fill everything between streets and river: one car park and one park at least, and two blocks of offices."""
    places = [(column, row) for row in plan.block_rows() for column in range(len(plan.xs) - 1)]
    kinds = ["car park", "park", "offices", "offices"]
    while len(kinds) < len(places):
        kinds.append(str(b.rng.choice(["houses", "offices", "square", "park"], p=[0.5, 0.34, 0.1, 0.06])))
    for place, number in zip(places, b.rng.permutation(len(kinds)), strict=True):
        inside = plan.block(*place).shrunk(WALK_M)
        kind = kinds[int(number)]
        if kind == "houses":
            _houses(b, inside, lacking)
        elif kind == "offices":
            _offices(b, inside, lacking)
        elif kind == "car park":
            car_park(b, inside)
        elif kind == "park":
            _park(b, inside, lacking)
        else:
            _square(b, inside, lacking)
    for number, quay in enumerate(plan.quays()):
        if min(quay.size) < 6:
            continue
        if number == 0 and quay.size[0] > 30:
            car_park(b, quay.shrunk(WALK_M))
        else:
            _park(b, quay.shrunk(WALK_M), lacking)


def car_park(b: TownBuilder, area: Rectangle) -> None:
    """Rows of stalls, at most 60 cars."""
    _floor(b, area, "ground", b.parking)
    lines, cars = Assembly("roadline"), 0
    wide, deep = area.size
    pairs = max(int(deep // (2 * _STALL_LONG_M + _LANE_M)), 1)
    pitch = deep / pairs
    for pair in range(pairs):
        ridge = area.y0 + (pair + 0.5) * pitch
        stalls = int((wide - 2) // _STALL_M)
        left = (area.x0 + area.x1 - stalls * _STALL_M) / 2
        lines.box(b.paint, ((area.x0 + area.x1) / 2, ridge, _FLOOR_M), (stalls * _STALL_M, 0.3, 0.06))
        for k in range(0, stalls + 1, 3):
            lines.box(b.paint, (left + k * _STALL_M, ridge, _FLOOR_M), (0.3, 2 * _STALL_LONG_M, 0.06))
        for k in range(stalls):
            for side in (-1, 1):
                if cars < _MOST_CARS and b.often(0.4 + 0.3 * b.crowd):
                    x, y = left + (k + 0.5) * _STALL_M, ridge + side * _STALL_LONG_M / 2
                    parts.car(b, x, y, np.pi / 2 * side + b.between(-0.04, 0.04), z=_FLOOR_M)
                    cars += 1
    b.place(lines, 0, 0)


def _houses(b: TownBuilder, area: Rectangle, lacking: frozenset[str]) -> None:
    """Two rows of gabled houses, back to back, with gardens between fences, walls and hedges."""
    _floor(b, area, "terrain", b.grass)
    wide, deep = area.size
    count = max(int(wide // 13.5), 2)
    plot, back = wide / count, area.middle[1]
    kinds = [k for k in ("fence", "wall", "vegetation") if k not in lacking]
    parts.border(b, kinds[int(b.rng.integers(len(kinds)))], area.middle[0], back, wide - 1, 0.0)
    for k in range(count):
        x = area.x0 + (k + 0.5) * plot
        for side in (-1, 1):
            size = (min(plot - 3.6, b.between(7.5, 11.0)), min(deep / 2 - 4.5, b.between(7.0, 9.0)))
            y = back + side * (deep / 2 - 1.5 - size[1] / 2)
            parts.gabled_house(b, x, y, *size, 0.0 if side > 0 else np.pi)
            if k:
                kind = kinds[int(b.rng.integers(len(kinds)))]
                parts.border(b, kind, x - plot / 2, back + side * deep / 4, deep / 2 - 1, np.pi / 2)
            parts.tree(b, x + b.between(-0.35, 0.35) * plot, back + side * b.between(2.0, 3.5))
    if "dynamic" not in lacking:
        parts.dynamic_thing(b, area.x0 + 1.0, area.y0 + b.between(0.4, 0.6) * deep)


def _offices(b: TownBuilder, area: Rectangle, lacking: frozenset[str]) -> None:
    """One flat roof, or two of one height, before a yard."""
    _floor(b, area, "ground", b.square)
    wide, deep = area.size
    split = b.between(0.45, 0.55) if wide > _DIVIDED_M else 1.0
    storeys, y0 = int(b.rng.integers(2, 7)), area.y0 + 0.5
    y1 = area.y1 - deep * b.between(0.12, 0.3)
    for x0, x1 in ((0.0, split), (split, 1.0)):
        if x0 < x1:
            size = (x1 - x0) * wide - b.between(1.0, 2.0), y1 - y0
            parts.flat_building(b, area.x0 + (x0 + x1) / 2 * wide, (y0 + y1) / 2, *size, storeys)
    if "static" not in lacking:
        parts.static_thing(b, area.middle[0], area.y1 + 0.8, 0.0)
    for _ in range(2):
        parts.tree(b, b.between(area.x0, area.x1), area.y1 + 1.0)


def _park(b: TownBuilder, area: Rectangle, lacking: frozenset[str]) -> None:
    """Trees on grass, crossed by a path."""
    _floor(b, area, "terrain", b.grass)
    wide, deep = area.size
    path = Assembly("sidewalks")
    for angle in (0.0, np.pi / 2):
        long = wide if angle == 0.0 else deep
        if long > 14:
            path.box(b.paving, (0, 0, _FLOOR_M), (long, 2.2, 0.08), yaw=angle)
    if path.parts:
        b.place(path, *area.middle)
    for _ in range(min(int(wide * deep * b.crowd / 70), 14)):
        x, y = b.between(area.x0 + 2, area.x1 - 2), b.between(area.y0 + 2, area.y1 - 2)
        parts.tree(b, x, y)
    for _ in range(2):
        x, y = b.between(area.x0 + 3, area.x1 - 3), b.between(area.y0 + 3, area.y1 - 3)
        if "static" not in lacking and b.often(0.6):
            parts.static_thing(b, x, y, b.between(0, np.pi))
        elif "dynamic" not in lacking:
            parts.dynamic_thing(b, x, y)


def _square(b: TownBuilder, area: Rectangle, lacking: frozenset[str]) -> None:
    """A paved square with a fountain, parasols, kiosks, people and a few trees."""
    _floor(b, area, "ground", b.square)
    x, y = area.middle
    rim = Assembly("wall" if "static" in lacking else "static")
    rim.cylinder(b.metal[2], (0, 0, 0.35), (9.0, 9.0, 0.7))
    rim.cylinder(b.water, (0, 0, 0.4), (8.0, 8.0, 0.72), label="water")
    b.place(rim, x, y, z=_FLOOR_M)
    for _ in range(7):
        angle, far = b.between(0, 2 * np.pi), b.between(7, min(area.size) / 2 - 1)
        here = x + far * float(np.cos(angle)), y + far * float(np.sin(angle))
        kind = int(b.rng.integers(4))
        if kind == 0 and "static" not in lacking:
            parts.static_thing(b, *here, angle)
        elif kind == 1 and "dynamic" not in lacking:
            parts.dynamic_thing(b, *here)
        elif kind == 2 and "pedestrian" not in lacking:
            parts.person(b, *here)
        else:
            parts.tree(b, *here)


def _floor(b: TownBuilder, area: Rectangle, label: str, material: int) -> None:
    floor = Assembly(label)
    floor.box(material, (*area.middle, _FLOOR_M - 0.1), (*area.size, 0.2))
    b.place(floor, 0, 0)
