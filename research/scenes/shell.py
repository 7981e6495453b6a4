"""Floor, ceiling and walls of a room; in some rooms an opening shows a piece of the next one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from research.scenes.furniture import FURNITURE
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Part, Shape, place_parts, rotation_z
from semantic_mapper.types import Float64

OPENING_SHARE = 0.4  # of the rooms
_BEYOND = ("dresser", "bookshelf", "wardrobe", "armchair", "plant", "open_rack", "sideboard")
_FLOORS = ("parquet", "parquet", "parquet", "wood", "tile", "stone", "fabric", "carpet", "carpet")
_WALLS = ("wallpaint", "wallpaint", "wallpaint", "tile")
_CORNER_M = 0.35  # of wall to leave beside an opening


@dataclass(slots=True)
class Shell:
    """Parts of the room itself: six groups (floor, ceiling, four walls), then what lies beyond an opening.

    Args:
        groups: Parts in world coordinates.
        lamp: (3,) a lamp in the next room; None without an opening.
        free: Lower and upper corner (3,) of the space to leave before the opening; None without one.
    """

    groups: list[list[Part]]
    lamp: Float64 | None = None
    free: tuple[Float64, Float64] | None = None


@dataclass(slots=True)
class _Opening:
    """A hole [x0, x1] x [0, height] in a wall, and the space behind it: [left, right] x [0, deep] x [0, ceiling]."""

    wall: int
    x0: float
    x1: float
    height: float
    left: float
    right: float
    deep: float
    has_leaf: bool
    hinge: int = field(default=1)
    swing: float = np.pi / 2  # of the leaf, into the next room; negative: into this one


def wall_pose(size_m: tuple[float, float, float], wall: int, along: float, away: float = 0.0) -> tuple[float, Float64]:
    """Yaw and position of a piece with its back to ``wall`` (0 = y 0, then counter-clockwise)."""
    w, d, _ = size_m
    yaw = wall * np.pi / 2
    corner = np.array([(0.0, 0.0), (w, 0.0), (w, d), (0.0, d)][wall])
    turn = rotation_z(yaw)[:2, :2]
    return yaw, np.append(corner + turn @ np.array([along, away]), 0.0)


def build_shell(
    size_m: tuple[float, float, float],
    rng: np.random.Generator,
    palette: Palette,
    *,
    wet: bool,
    variety: np.random.Generator | None = None,
) -> Shell:
    """The shell of a room. ``wet``: a bathroom, with tiles. ``variety`` draws the doors of a varied room, which stand
    open by any angle, to either side."""
    w, d, h = size_m
    floors, walls = (("tile",), ("tile", "wallpaint")) if wet else (_FLOORS, _WALLS)
    floor, wall = palette.pick(rng, *floors, role="floor"), palette.pick(rng, *walls)
    ceiling, board = palette.pick(rng, "wallpaint", "paint"), palette.pick(rng, "wood", "paint")
    accent = palette.pick(rng, "wallpaint", "paint", "wood") if rng.uniform() < 0.3 else wall
    opening = _draw_opening(size_m, rng) if variety is None else _draw_door(size_m, variety)
    groups: list[list[Part]] = []
    for label, material, z in (("floor", floor, -0.05), ("ceiling", ceiling, h + 0.05)):
        slab = Assembly(label)
        slab.box(material, (w / 2, d / 2, z), (w + 0.2, d + 0.2, 0.1))
        groups.append(slab.parts)
    for k in range(4):
        piece = _wall(size_m[k % 2], h, accent if k == 0 else wall, board, opening if opening.wall == k else None)
        groups.append(place_parts(piece, *wall_pose(size_m, k, 0.0)))
    if opening.wall < 0:
        return Shell(groups)
    pose = wall_pose(size_m, opening.wall, 0.0)
    for piece in _beyond(opening, h, rng, palette, floor, wall, ceiling):
        groups.append(place_parts(piece, *pose))
    turn = rotation_z(pose[0])
    middle = (opening.x0 + opening.x1) / 2
    lamp = turn @ np.array([middle, -0.1 - opening.deep / 2, h - 0.35]) + pose[1]
    corners = np.array([(x, y, 0.0) for x in (opening.x0 - 0.05, opening.x1 + 0.05) for y in (0.0, 0.9)])
    zone = corners @ turn.T + pose[1]
    low, high = zone.min(0), zone.max(0)
    low[2], high[2] = 0.05, 2.35
    return Shell(groups, lamp, (low, high))


def _draw_opening(size_m: tuple[float, float, float], rng: np.random.Generator) -> _Opening:
    """``wall`` is -1 without a wall."""
    wall = int(rng.integers(4)) if rng.uniform() < OPENING_SHARE else -1
    length = size_m[wall % 2]
    has_leaf = rng.uniform() < 0.5
    width = rng.uniform(0.78, 0.95) if has_leaf else rng.uniform(0.85, min(1.7, length - 2 * _CORNER_M - 0.3))
    x0 = rng.uniform(_CORNER_M, length - _CORNER_M - width)
    height = rng.uniform(1.98, 2.1) if has_leaf else rng.uniform(2.0, min(2.3, size_m[2] - 0.1))
    return _Opening(
        wall, x0, x0 + width, height, x0 - rng.uniform(0.3, 1.3), x0 + width + rng.uniform(0.3, 1.3),
        rng.uniform(1.4, 2.6), has_leaf, 1 if rng.uniform() < 0.5 else -1,
    )  # fmt: skip


def _draw_door(size_m: tuple[float, float, float], rng: np.random.Generator) -> _Opening:
    """An opening that more rooms have, and that more often has a leaf."""
    opening = _draw_opening(size_m, rng)
    if opening.wall < 0:
        opening = _draw_opening(size_m, rng)
    if not opening.has_leaf:
        return opening
    swing = rng.uniform(0.15, 1.9) if rng.uniform() < 0.5 else -rng.uniform(0.15, np.pi / 2)
    return replace(opening, swing=float(swing))


def _wall(length: float, h: float, material: int, board: int, opening: _Opening | None) -> Assembly:
    """A wall from x = 0 to ``length``, its face at y = 0, with a skirting board; whole, or left and right of a hole."""
    wall = Assembly("wall")
    spans = [(-0.1, length + 0.1)] if opening is None else [(-0.1, opening.x0), (opening.x1, length + 0.1)]
    for x0, x1 in spans:
        wall.box(material, ((x0 + x1) / 2, -0.05, h / 2), (x1 - x0, 0.1, h))
        foot0, foot1 = max(x0, 0.0), min(x1, length)
        wall.box(board, ((foot0 + foot1) / 2, -0.0445, 0.035), (foot1 - foot0, 0.109, 0.07))
    if opening is not None:
        x, top = (opening.x0 + opening.x1) / 2, opening.height
        wall.box(material, (x, -0.05, (top + h) / 2), (opening.x1 - opening.x0, 0.1, h - top))
    return wall


def _beyond(
    o: _Opening, h: float, rng: np.random.Generator, palette: Palette, floor: int, wall: int, ceiling: int
) -> list[Assembly]:
    """What the opening shows, in the frame of its wall: frame and leaf of the door, shell and a piece of the room."""
    width, middle, back = o.right - o.left, (o.left + o.right) / 2, -0.1 - o.deep
    if rng.uniform() < 0.5:
        floor, wall = palette.pick(rng, "parquet", "tile", "carpet"), palette.pick(rng, "wallpaint", "tile")
    pieces: list[Assembly] = []
    for label, material, center, size in (
        ("floor", floor, (middle, back / 2 - 0.05, -0.051), (width + 0.2, o.deep + 0.2, 0.1)),
        ("ceiling", ceiling, (middle, back / 2 - 0.05, h + 0.051), (width + 0.2, o.deep + 0.2, 0.1)),
        ("wall", wall, (middle, back - 0.05, h / 2), (width + 0.2, 0.1, h)),
        ("wall", wall, (o.left - 0.05, back / 2 - 0.05, h / 2), (0.1, o.deep, h)),
        ("wall", wall, (o.right + 0.05, back / 2 - 0.05, h / 2), (0.1, o.deep, h)),
    ):
        side = Assembly(label)
        side.add(Shape.BOX, material, center, size)
        pieces.append(side)
    pieces.append(_door_frame(o, rng, palette))
    name = _BEYOND[int(rng.integers(len(_BEYOND)))]
    piece = FURNITURE[name].make(rng, palette)
    low, high = piece.bounds()
    room_x, room_y = width - 0.1 - (high[0] - low[0]), o.deep - 0.2 - (high[1] - low[1])
    leaf_side = o.has_leaf and room_y < (o.x1 - o.x0)  # it would stand where the leaf swings
    if room_x > 0 and room_y > 0 and not leaf_side:
        x = o.left + 0.05 + rng.uniform() * room_x - low[0]
        shift = np.array([x, back + 0.02 - min(low[1], 0.0), 0.0])
        moved = Assembly(piece.label, place_parts(piece, 0.0, shift))
        pieces.append(moved)
    return pieces


def _door_frame(o: _Opening, rng: np.random.Generator, palette: Palette) -> Assembly:
    """Jambs and head round the hole; the leaf, where there is one, stands open into the next room."""
    frame = Assembly("door")
    wood = palette.pick(rng, "wood", "paint", role="door")
    width = o.x1 - o.x0
    for x in (o.x0 + 0.02, o.x1 - 0.02):
        frame.box(wood, (x, -0.05, o.height / 2), (0.04, 0.13, o.height))
    frame.box(wood, ((o.x0 + o.x1) / 2, -0.05, o.height - 0.02), (width - 0.08, 0.128, 0.04))
    if o.has_leaf:
        leaf, metal = palette.pick(rng, "wood", "paint", role="door"), palette.pick(rng, "metal", "dark")
        if o.swing == np.pi / 2:
            x = o.x1 - 0.065 if o.hinge > 0 else o.x0 + 0.065
            frame.box(leaf, (x, -0.12 - width / 2, o.height / 2), (0.045, width - 0.06, o.height - 0.05), item=1)
            inner = x - o.hinge * 0.05
            frame.box(metal, (inner, -0.12 - width + 0.12, 1.03), (0.03, 0.12, 0.03), item=1)
        else:
            _swung_leaf(frame, o, leaf, metal)
    return frame


def _swung_leaf(frame: Assembly, o: _Opening, leaf: int, metal: int) -> None:
    """The leaf at ``o.swing``, with two panels and a handle on each side."""
    away = 1.0 if o.swing < 0 else -1.0  # along y, to where it opens
    width = o.x1 - o.x0 - 0.1
    hinge = np.array([o.x1 - 0.05 if o.hinge > 0 else o.x0 + 0.05, away * 0.04 - 0.05])
    angle = abs(o.swing)
    along = np.array([-o.hinge * np.cos(angle), away * np.sin(angle)])  # from the hinge to the lock
    across = np.array([-along[1], along[0]])
    yaw = float(np.arctan2(along[1], along[0]))

    def add(material: int, way: float, z: float, size: tuple[float, float, float], off: float = 0.0) -> None:
        x, y = hinge + along * way + across * off
        frame.box(material, (float(x), float(y), z), size, yaw=yaw, item=1)

    add(leaf, width / 2, o.height / 2, (width, 0.04, o.height - 0.05))
    for z, tall in ((0.27, 0.32), (0.72, 0.4)):
        add(leaf, width / 2, z * o.height, (width * 0.66, 0.054, tall * o.height))
    for side in (-1, 1):
        add(metal, width - 0.1, 1.03, (0.12, 0.03, 0.03), side * 0.05)
