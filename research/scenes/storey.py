"""A storey: furnished rooms that share walls and are joined by doors, and a survey that looks at all of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from research.scenes.config import SUITE_VERSION, TRAIN_SEEDS, NoiseConfig
from research.scenes.daylight import pose_of
from research.scenes.layout import Layout
from research.scenes.materials import Palette
from research.scenes.primitives import Part, Primitives, pack
from research.scenes.render import RenderedView, render_view
from research.scenes.room_templates import furnish
from research.scenes.scene import NO_LAMPS, Scene
from research.scenes.shell import Doorway, shell_between
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import CameraIntrinsics, Float64

WALL_M = 0.1
CORRIDOR = "corridor"
_STREAM = 7  # number of the random stream
_LEAST_SIDE_M = 2.3
_LARGE_M2 = 22.0  # a room above is divided again
_SHARED_M = 1.4  # of wall that two rooms need to share for a door
_BATHROOM_M2 = 8.0
_TEMPLATES = ("living", "kitchen", "bedroom", "office", "bedroom", "studio")
_REACH_M = 6.0  # what is farther than this from a camera is not drawn
_STAND_M2 = 3.0  # of floor for each place where the survey stops
_STEP_M = 0.35
_CLEARANCE_M = 0.25
_EYE_M = 1.3
_YAWS = 8
_PITCHES = (-0.5, 0.05)

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1 in metres


@dataclass(frozen=True, slots=True, eq=False)
class StoreyRoom:
    """One room: the rectangle between its walls' faces, and its template, or ``CORRIDOR``."""

    low: Float64
    high: Float64
    template: str


@dataclass(frozen=True, slots=True, eq=False)
class StoreyDoor:
    """An open door between two rooms: (2,) middle and width, metres."""

    rooms: tuple[int, int]
    center: Float64
    width_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Storey:
    """A storey; its scene's floor is z = 0."""

    scene: Scene
    rooms: tuple[StoreyRoom, ...]
    doors: tuple[StoreyDoor, ...]

    def room_at(self, xy: Float64) -> np.ndarray:
        """Number (N,) of the room in which points (N, 2) lie, -1 in none."""
        found = np.full(len(xy), -1)
        for number, room in enumerate(self.rooms):
            found[((xy >= room.low) & (xy <= room.high)).all(1)] = number
        return found


def make_storey(seed: int, area_m2: float = 110.0, clutter: float = 0.3) -> Storey:
    """A storey of about ``area_m2``: an even seed has rooms on both sides of a corridor, an odd one has none.

    Raises ConfigError: negative seed, or an area too small for two rooms.
    """
    if seed < 0 or not area_m2 >= 20.0:
        raise ConfigError(f"make_storey: need seed >= 0 and area_m2 >= 20, got {seed} and {area_m2}")
    rng = np.random.default_rng((SUITE_VERSION, seed, _STREAM))
    while True:
        rectangles, has_corridor = _plan(rng, area_m2, corridor=seed % 2 == 0)
        doors = _draw_doors(rectangles, rng, has_corridor=has_corridor)
        if doors is not None:
            break
    height = float(rng.uniform(2.4, 2.8))
    palette = Palette(rng, held_out=seed not in TRAIN_SEEDS, camouflage=0.0)
    rooms: list[StoreyRoom] = []
    groups: list[list[Part]] = []
    for number, rectangle in enumerate(rectangles):
        low, high = np.array(rectangle[:2]), np.array(rectangle[2:])
        w, d = (high - low).tolist()
        small = w * d < _BATHROOM_M2
        template = "bathroom" if small else _TEMPLATES[int(rng.integers(len(_TEMPLATES)))]
        template = CORRIDOR if has_corridor and number == 0 else template
        own = [_doorway(door, number, rectangle) for door in doors if number in door.rooms]
        shell = shell_between((w, d, height), own, WALL_M / 2, rng, palette, wet=template == "bathroom")
        layout = Layout((w, d, height), rng, palette, shell=shell)
        if template != CORRIDOR:
            furnish(layout, template, clutter)
        shift = np.append(low, 0.0)
        groups.extend([replace(part, center=part.center + shift) for part in group] for group in layout.groups)
        rooms.append(StoreyRoom(low, high, template))
    size = (max(r[2] for r in rectangles), max(r[3] for r in rectangles), height)
    scene = Scene(seed, "storey", size, pack(groups), palette.table(), NO_LAMPS)
    return Storey(scene, tuple(rooms), tuple(doors))


def survey_poses(storey: Storey) -> Float64:
    """T_world_camera (N, 4, 4): stops all over each room, and at each of them a look all round, up and down."""
    low, high = storey.scene.primitives.bounds()
    poses: list[Float64] = []
    for room in storey.rooms:
        axes = [
            np.arange(a + _CLEARANCE_M, b - _CLEARANCE_M, _STEP_M) for a, b in zip(room.low, room.high, strict=True)
        ]
        points = np.array([(x, y, _EYE_M) for x in axes[0] for y in axes[1]])
        gap = np.maximum(np.maximum(low - points[:, None], points[:, None] - high), 0.0)
        clear = np.linalg.norm(gap, axis=2).min(axis=1)
        free = points[clear >= min(_CLEARANCE_M, float(clear.max()))]
        count = 1 + int(np.prod(room.high - room.low) / _STAND_M2)
        for place in _spread(free, count):
            for k in range(_YAWS):
                poses.append(pose_of(place, 2 * np.pi * k / _YAWS, _PITCHES[k % 2]))
                poses.append(pose_of(place, 2 * np.pi * k / _YAWS, _PITCHES[1 - k % 2]))
    return np.array(poses)


def survey_views(
    storey: Storey, poses: Float64, intrinsics: CameraIntrinsics, noise: NoiseConfig | None = None
) -> Iterator[RenderedView]:
    """One view for each of ``poses`` (N, 4, 4), of what is within 6 m; ``noise`` as for ``sequence.room_views``."""
    primitives = storey.scene.primitives
    low, high = primitives.bounds()
    for index, T_world_camera in enumerate(poses):
        eye, ahead = T_world_camera[:3, 3], T_world_camera[:3, 2]
        gap = np.maximum(np.maximum(low - eye, eye - high), 0.0)
        reach = np.where(ahead > 0, high, low) @ ahead - eye @ ahead  # of the corner that is farthest ahead
        near = np.flatnonzero((np.linalg.norm(gap, axis=1) < _REACH_M) & (reach > 0))
        part = Primitives(*(getattr(primitives, name)[near] for name in Primitives.__dataclass_fields__))
        seed = None if noise is None else storey.scene.seed * 100_003 + index
        scene = replace(storey.scene, primitives=part)
        yield render_view(scene, intrinsics, T_world_camera, noise=seed, noise_config=noise or NoiseConfig())


def _spread(points: Float64, count: int) -> Float64:
    """``count`` of points (N, 3), each the farthest from those before."""
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    far = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _plan(rng: np.random.Generator, area_m2: float, *, corridor: bool) -> tuple[list[Rectangle], bool]:
    """The rooms, the corridor first if there is one."""
    ratio = float(rng.uniform(1.0, 1.6))
    w, d = (area_m2 * ratio) ** 0.5, (area_m2 / ratio) ** 0.5
    if not corridor or d < 2 * _LEAST_SIDE_M + 2.0:
        return _divide((0.0, 0.0, w, d), rng), False
    wide = float(rng.uniform(1.2, 1.9))
    y0 = float(rng.uniform(0.4, 0.6)) * (d - wide)
    y1 = y0 + wide
    rows = ((0.0, 0.0, w, y0 - WALL_M), (0.0, y1 + WALL_M, w, d))
    return [(0.0, y0, w, y1), *(room for row in rows for room in _divide_row(row, rng))], True


def _divide_row(row: Rectangle, rng: np.random.Generator) -> list[Rectangle]:
    x0, y0, x1, y1 = row
    rooms: list[Rectangle] = []
    while x1 - x0 > 2 * _LEAST_SIDE_M + WALL_M:
        wide = float(rng.uniform(_LEAST_SIDE_M, min(5.0, x1 - x0 - _LEAST_SIDE_M - WALL_M)))
        rooms.append((x0, y0, x0 + wide, y1))
        x0 += wide + WALL_M
    return [*rooms, (x0, y0, x1, y1)]


def _divide(room: Rectangle, rng: np.random.Generator) -> list[Rectangle]:
    """Divide a room until none is large, by walls across its longer side."""
    x0, y0, x1, y1 = room
    w, d = x1 - x0, y1 - y0
    if w * d < float(rng.uniform(0.5, 1.0)) * _LARGE_M2 or max(w, d) < 2 * _LEAST_SIDE_M + WALL_M:
        return [room]
    least = _LEAST_SIDE_M / (max(w, d) - WALL_M)
    at = float(rng.uniform(max(least, 0.3), 1 - max(least, 0.3))) * (max(w, d) - WALL_M)
    if w >= d:
        halves = (x0, y0, x0 + at, y1), (x0 + at + WALL_M, y0, x1, y1)
    else:
        halves = (x0, y0, x1, y0 + at), (x0, y0 + at + WALL_M, x1, y1)
    return [part for half in halves for part in _divide(half, rng)]


def _draw_doors(rooms: list[Rectangle], rng: np.random.Generator, *, has_corridor: bool) -> list[StoreyDoor] | None:
    """A door to each room from one that is reached already, and a few more; None where a room cannot be reached."""
    pairs = [(a, b, s) for a in range(len(rooms)) for b in range(a) if (s := _shared_wall(rooms[a], rooms[b]))]
    order = [pairs[k] for k in rng.permutation(len(pairs))]
    order.sort(key=lambda pair: pair[1] != 0 if has_corridor else 0)  # from the corridor, where they can be
    joined = list(range(len(rooms)))
    doors: list[StoreyDoor] = []
    for a, b, (axis, wall, start, end) in order:
        if joined[a] == joined[b] and rng.uniform() > 0.15:
            continue
        joined = [joined[b] if j == joined[a] else j for j in joined]
        width = float(rng.uniform(0.75, 1.0))
        middle = float(rng.uniform(start + width / 2 + 0.15, end - width / 2 - 0.15))
        doors.append(StoreyDoor((a, b), np.array((wall, middle) if axis == 0 else (middle, wall)), width))
    return doors if len(set(joined)) == 1 else None


def _shared_wall(a: Rectangle, b: Rectangle) -> tuple[int, float, float, float] | None:
    """Axis across the wall between two rooms, its place on that axis, and its ends on the other one."""
    for axis in (0, 1):
        other = 1 - axis
        start, end = max(a[other], b[other]), min(a[other + 2], b[other + 2])
        for low, high in ((a, b), (b, a)):
            if abs(high[axis] - low[axis + 2] - WALL_M) < 1e-6 and end - start >= _SHARED_M:
                return axis, low[axis + 2] + WALL_M / 2, start, end
    return None


def _doorway(door: StoreyDoor, room: int, rectangle: Rectangle) -> Doorway:
    """The door as the room with that number has it; see ``shell.wall_pose`` for its walls."""
    x, y = door.center - rectangle[:2]
    w, d = rectangle[2] - rectangle[0], rectangle[3] - rectangle[1]
    away = (abs(y), abs(x - w), abs(y - d), abs(x))  # of the door from each wall
    wall = int(np.argmin(away))
    along = float((x, y, w - x, d - y)[wall])
    return Doorway(wall, along, door.width_m, 2.03, door.rooms[0] == room)
