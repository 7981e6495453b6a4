"""Floors, rooms, doors and things of a map, which belong to which, and their picture. Ids stay while the map grows."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import scipy  # loads `ndimage` when it is first used
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import PLAIN_NAMES, STUFF_NAMES, LabelSet
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.plots import CYCLE, SMALL_PT, TITLE_PT, cut, new_figure, rendered
from semantic_mapper.queries.checks import check_up
from semantic_mapper.queries.instances import LEAST_OVERLAP, Instance, InstanceTracker
from semantic_mapper.queries.occupancy import State, read_states
from semantic_mapper.queries.rooms import RoomPlan, find_walls, part_rooms
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import SurfaceVoxels, surface_voxels, up_in
from semantic_mapper.types import Bool, Float64, Int64, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from semantic_mapper.mapping.voxel_map import VoxelMap

CELL_M = 0.05  # of a plan, or a voxel where that is larger
STOREY_M = 1.8  # floors are at least so far from each other
FLOOR_SHARE = 0.2  # of the largest floor: less level surface is no floor
LEAST_FLOOR_M2 = 2.0
LAYER_M = 0.05  # of heights, among which floors are looked for
LOW_M = (-0.15, 0.4)  # above the floor: surface here is floor, or stands on it
BODY_M = (0.4, 1.6)  # above the floor: here walls differ from doors, whose lintel is higher
HIGH_M = 2.4  # above the floor: up to here a wall shows over what hides it below, and over doors
WALL_LAYER_M = 0.2
WALL_LAYERS = (3, 2)  # that a wall fills at least, of the 6 of the body, and of the 4 above
ROOM_VOXELS = 2000  # of a thing are looked up to find its room, or up to twice as many
NEAR_ROOM_M = 0.4  # what hangs at a wall, or stands in it, belongs to a room so near
FLOOR_WIDTH, FLOOR_HEIGHT = 900, 760
NAMED_M = 0.7  # smaller things have no names
LETTER_PX, PLAN_FRACTION = 7, 0.8  # width of a letter; how much of a picture its plan takes
# Things that cover walls: where they hang there is no way through. Doors are no walls, open or closed.
HUNG_NAMES = frozenset("window picture curtain blinds mirror showercurtain whiteboard".split())
LEVEL_NAMES = frozenset("floor floormat ceiling".split())


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """One level: its height in metres along up from the origin of the world, and its rooms' ids."""

    id: int
    height_m: float
    rooms: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """One room."""

    id: int  # above 0; stays with the room from update to update, and is never given to another
    floor: int  # id of its floor
    area_m2: float  # of its floor, with what furniture covers
    center: Float64  # (3,) float64 world metres, on the floor where that is widest
    outline: Float64  # (N, 3) float64 world metres, on the floor, anticlockwise seen from above; holes are left out


@dataclass(frozen=True, slots=True, eq=False)
class Door:
    """A passage between two rooms, ids ascending: its middle (3,) on the floor in the world, and its width, metres."""

    rooms: tuple[int, int]
    center: Float64
    width_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SceneGraph:
    """What a map consists of."""

    up: Float64  # (3,) unit vector
    floors: tuple[Floor, ...]  # by height
    rooms: tuple[Room, ...]  # by id
    doors: tuple[Door, ...]  # between them, by rooms
    things: tuple[Instance, ...]  # by id, as ``InstanceTracker`` finds them
    # id of the room that holds most of a thing, for each id of a thing; None = none does
    room_of: dict[int, int | None]


class _Plan(NamedTuple):
    """Rooms of one floor on cells of the world: ``ids`` (H, W), 0 = none, from cell ``first`` (x, y) on."""

    floor: int
    height_m: float
    first: Int64
    ids: Int64


class GraphTracker:
    """Finds the graph of one map again and again. Safe to call from several threads.

    A room is what an earlier one became where it holds the most of that one's floor, and at least a tenth; of several
    that became one, the oldest id stays. A floor is the earlier one within half a metre of its height. ``up`` (3,) in
    the world is by default found by the floor of the first map that has one."""

    def __init__(self, up: ArrayLike | None = None) -> None:
        self._up = None if up is None else check_up(up)
        self._things: InstanceTracker | None = None
        self._plans: tuple[_Plan, ...] = ()
        self._cell_m = CELL_M
        self._next_floor = self._next_room = 1
        self._lock = threading.Lock()

    @property
    def gone(self) -> tuple[Instance, ...]:
        """The things that had gone by the last update; none where another finds the things."""
        with self._lock:
            return () if self._things is None else self._things.gone

    def up_in(self, snapshot: MapSnapshot) -> Float64:
        """Unit vector up (3,) in the world, found by the floor of this map at first; else ``MapError``."""
        with self._lock:
            if self._up is None:
                self._up = up_in(snapshot)
            return self._up

    def update(self, snapshot: MapSnapshot, things: Sequence[Instance] | None = None) -> SceneGraph:
        """The graph of the map as it is now, with ``things`` of it that another has found; by default this finds them.
        ``MapError``: lengths of the map are not metres, or which way is up is not known."""
        require_metres(snapshot.scale_known, "graph")
        up = self.up_in(snapshot)
        R_grid_world = turn_onto(up, np.array((0.0, 0.0, 1.0)))
        cell_m = max(CELL_M, snapshot.voxel_size_m)
        with self._lock:
            if things is None:
                self._things = self._things or InstanceTracker(up=up)
                things = self._things.update(snapshot)
            things = tuple(things)
            every = max(1, 2 * int(CELL_M / snapshot.voxel_size_m) - 1)
            xyz, label, level = _surface(snapshot, R_grid_world, every)
            heights = find_floors(xyz[level, 2], snapshot.voxel_size_m**2 * every)
            plans, floors = list[_Plan](), list[Floor]()
            rooms, doors = list[Room](), list[Door]()
            for height, above in zip(heights, [*heights, np.inf][1:], strict=True):
                within = (xyz[:, 2] >= height + LOW_M[0]) & (xyz[:, 2] < min(above + LOW_M[0], height + HIGH_M))
                first, seen, wall = _plan(xyz[within], label[within], height, cell_m, snapshot.label_set)
                found = part_rooms(seen, wall, cell_m)
                plan, ids = self._identify(found, height, first, plans)
                plans.append(plan)
                floors.append(Floor(plan.floor, height, tuple(sorted(ids))))
                rooms += [_describe(found, number, room, plan, R_grid_world, cell_m) for number, room in enumerate(ids)]
                for passage in found.passages:
                    one, other = sorted(ids[number] for number in passage.rooms)
                    middle = _to_world(np.array(passage.cell[::-1]) + 0.5, plan, R_grid_world, cell_m)
                    doors.append(Door((one, other), middle, passage.width_m))
            self._plans, self._cell_m = tuple(plans), cell_m
        return SceneGraph(
            up,
            tuple(floors),
            tuple(sorted(rooms, key=lambda room: room.id)),
            tuple(sorted(doors, key=lambda door: door.rooms)),
            things,
            {t.id: _room_of(t.voxels * np.float64(snapshot.voxel_size_m), R_grid_world, plans, cell_m) for t in things},
        )

    def room_of(self, points: Float64) -> int | None:
        """Room of the last update that holds most of points (N, 3), world metres, of a thing; None = none does."""
        with self._lock:
            up = np.array((0.0, 0.0, 1.0)) if self._up is None else self._up
            return _room_of(points, turn_onto(up, np.array((0.0, 0.0, 1.0))), self._plans, self._cell_m)

    def _identify(
        self, found: RoomPlan, height: float, first: Int64, taken: Sequence[_Plan]
    ) -> tuple[_Plan, list[int]]:
        """The plan with ids that last, and the id of each of its rooms; ``taken`` are plans of other floors."""
        used = {plan.floor for plan in taken}
        before = [plan for plan in self._plans if plan.floor not in used and abs(plan.height_m - height) < 0.5]
        last = min(before, key=lambda plan: abs(plan.height_m - height), default=None)
        ids = np.zeros(found.rooms, np.int64)
        if last is not None:
            _match(last, found, first, ids)
        new = np.flatnonzero(ids == 0)
        ids[new] = self._next_room + np.arange(len(new))
        self._next_room += len(new)
        floor = self._next_floor if last is None else last.floor
        self._next_floor += last is None
        return _Plan(floor, height, first, np.append(ids, 0)[found.room]), ids.tolist()


def find_graph(voxel_map: VoxelMap) -> SceneGraph | None:
    """The graph of a finished map; None where its lengths are not metres, or nothing in it is known to be floor."""
    if not voxel_map.scale_known:
        return None
    try:
        return GraphTracker().update(MapMirror.of(voxel_map).snapshot())
    except MapError:
        return None


def find_floors(height: Float64, area_m2: float) -> list[float]:
    """Heights of floors, ascending, where level surface is largest, and as far apart as storeys are: by the heights
    (N,) in metres of voxels that one could stand on, each of which covers ``area_m2``."""
    if not len(height):
        return []
    layer = np.floor(height / LAYER_M).astype(np.int64)
    counts = np.bincount(layer - layer.min())
    area = np.convolve(counts, np.ones(3), "same") * area_m2
    least = max(LEAST_FLOOR_M2, FLOOR_SHARE * float(area.max()))
    found: list[float] = []
    for k in np.argsort(-area, kind="stable"):
        if area[k] < least:
            break
        middle = float(np.median(height[np.abs(layer - layer.min() - k) <= 1]))
        if all(abs(middle - other) >= STOREY_M for other in found):
            found.append(middle)
    return sorted(found)


def _surface(snapshot: MapSnapshot, R_grid_world: Float64, every: int) -> tuple[Float64, UInt8, Bool]:
    """Surface points (N, 3) in the plan's frame, metres, z up; class ids (N,); whether one could stand there (N,). One
    of ``every`` voxels is kept, by the sum of its coordinates: so many that each cell of the plan has one."""
    surface = surface_voxels(snapshot)
    if every > 1:
        x, y, z = (surface.voxel >> shift & 7 for shift in (0, 3, 6))  # in its block of 8^3
        number = x + y + z + 8 * snapshot.keys.sum(axis=1)[surface.row]
        kept = number % every == 0
        surface = SurfaceVoxels(surface.row[kept], surface.voxel[kept], surface.point[kept])
    label = snapshot.voxels.label[snapshot.slots[surface.row], surface.voxel]
    up = R_grid_world[2]
    above = read_states(surface.point + 1.5 * up, snapshot)
    level = above == State.FREE
    level[level] = read_states(surface.point[level] - 1.5 * up, snapshot) != State.FREE
    return surface.point @ (R_grid_world.T * snapshot.voxel_size_m), label, level


def _plan(xyz: Float64, label: UInt8, floor_m: float, cell_m: float, labels: LabelSet) -> tuple[Int64, Bool, Bool]:
    """First cell (x, y), and on cells (H, W), row = y, where floor or furniture was seen, and where there is a wall.
    Surface without a class is a wall where most of the map has none; elsewhere it is the back of something thin."""
    furniture, upright = np.zeros(256, np.bool_), np.ones(256, np.bool_)
    furniture[list(labels.thing_ids(STUFF_NAMES | HUNG_NAMES))] = True
    upright[[i for i, name in zip(labels.ids, labels.names, strict=True) if name in LEVEL_NAMES]] = False
    cell = np.floor(xyz[:, :2] / cell_m + 0.5).astype(np.int64)
    first = cell.min(axis=0) - 1
    width, rows = (cell.max(axis=0) - first + 2).tolist()
    column, row = (cell - first).T
    height, is_furniture = xyz[:, 2] - floor_m, furniture[label]
    seen = np.zeros((rows, width), np.bool_)
    shown = (is_furniture & (height < BODY_M[1])) | (height < LOW_M[1])
    seen[row[shown], column[shown]] = True
    unnamed = label == labels.ignore_id
    upright[labels.ignore_id] = unnamed.mean() > 0.5
    is_wall = ~is_furniture & upright[label] & (height >= BODY_M[0])
    layer = ((height[is_wall] - BODY_M[0]) / WALL_LAYER_M).astype(np.int64)
    filled = np.zeros((int(layer.max(initial=0)) + 1, rows, width), np.bool_)
    filled[layer, row[is_wall], column[is_wall]] = True
    body = round((BODY_M[1] - BODY_M[0]) / WALL_LAYER_M)
    low, high = filled[:body].sum(axis=0), filled[body:].sum(axis=0)
    return first, seen, find_walls((low >= WALL_LAYERS[0]) | ((high >= WALL_LAYERS[1]) & ~seen), cell_m)


def _to_world(xy: Float64, plan: _Plan, R_grid_world: Float64, cell_m: float) -> Float64:
    """World points (..., 3) of column and row (..., 2) of a plan, as real numbers, on the floor."""
    flat = (plan.first + xy - 0.5) * cell_m
    return np.concatenate((flat, np.full((*flat.shape[:-1], 1), plan.height_m)), axis=-1) @ R_grid_world


def _describe(found: RoomPlan, number: int, room_id: int, plan: _Plan, R_grid_world: Float64, cell_m: float) -> Room:
    own = found.room == number
    widest = np.unravel_index(int(np.where(own, found.clearance_m, -1).argmax()), own.shape)
    # Twice the size, so that the outline runs along the outer edges of the cells, and no cell is a line.
    twice = np.repeat(np.repeat(own.astype(np.uint8), 2, axis=0), 2, axis=1)
    contours, _ = cv2.findContours(twice, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    corners = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 2.0, True).reshape(-1, 2).astype(np.float64)
    if cv2.contourArea(corners.astype(np.float32), oriented=True) < 0:
        corners = corners[::-1]
    center = _to_world(np.array(widest[::-1], np.float64) + 0.5, plan, R_grid_world, cell_m)
    outline = _to_world(corners / 2 + 0.25, plan, R_grid_world, cell_m)
    return Room(room_id, plan.floor, float(own.sum()) * cell_m**2, center, outline)


def _match(last: _Plan, found: RoomPlan, first: Int64, numbers: Int64) -> None:
    """Write the ids (R,) of the earlier rooms that these still are, 0 where one is new."""
    shift = last.first - first  # of the earlier plan's cells in this one
    rows, columns = np.indices(last.ids.shape)
    rows, columns = rows + shift[1], columns + shift[0]
    height, width = found.room.shape
    there = (last.ids > 0) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    now, was = found.room[rows[there], columns[there]], last.ids[there]
    for old in np.unique(last.ids[last.ids > 0]):
        overlap = np.bincount(now[(was == old) & (now >= 0)], minlength=max(found.rooms, 1))
        best = int(overlap.argmax())
        if overlap[best] >= max(1, LEAST_OVERLAP * (last.ids == old).sum()) and numbers[best] == 0:
            numbers[best] = old


def _room_of(points: Float64, R_grid_world: Float64, plans: Sequence[_Plan], cell_m: float) -> int | None:
    """Id of the room that holds most of a thing's points (N, 3), world metres, or is nearest to most of them."""
    xyz = points[:: 1 + len(points) // ROOM_VOXELS] @ R_grid_world.T
    below = [plan for plan in plans if plan.height_m <= float(np.median(xyz[:, 2])) + LOW_M[1]]
    if not below:
        return None
    plan = below[-1]
    cell = np.floor(xyz[:, :2] / cell_m + 0.5).astype(np.int64) - plan.first
    reach = round(NEAR_ROOM_M / cell_m)
    low, high = np.maximum(cell.min(0) - reach, 0), cell.max(0) + reach + 1
    part = plan.ids[low[1] : high[1], low[0] : high[0]]
    if not part.any():
        return None
    distance, at = scipy.ndimage.distance_transform_edt(part == 0, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    column, row = (cell - low).T
    here = (column >= 0) & (row >= 0) & (column < part.shape[1]) & (row < part.shape[0])
    column, row = column[here], row[here]
    near = distance[row, column] <= reach
    ids = part[tuple(at[:, row[near], column[near]])]
    return int(np.bincount(ids).argmax()) if len(ids) else None


@rendered
def draw_graph(title: str, graph: SceneGraph) -> Figure:
    """Rooms in colours with id and area, doors as white dots with their width, things as dots, the large with class; a
    name that would cover another is left out."""
    count = max(len(graph.floors), 1)
    figure = new_figure(FLOOR_WIDTH * count, FLOOR_HEIGHT, layout="constrained")
    figure.suptitle(cut(title, FLOOR_WIDTH * count - 30, TITLE_PT, "bold"), x=0.012, ha="left")
    R_grid_world = turn_onto(graph.up, np.array((0.0, 0.0, 1.0)))
    for number, floor in enumerate(graph.floors, start=1):
        axes = figure.add_subplot(
            1, count, number, aspect="equal", adjustable="datalim", xlabel="metres", ylabel="metres"
        )
        axes.set_title(f"floor {floor.id} at {round(floor.height_m, 2) + 0.0:.2f} m")  # + 0: no minus before zero
        axes.grid(visible=False)
        _draw_floor(axes, graph, floor, R_grid_world)
    return figure


def _draw_floor(axes: Axes, graph: SceneGraph, floor: Floor, R_grid_world: Float64) -> None:
    def plan(xyz: Float64) -> Float64:
        return (xyz @ R_grid_world.T)[..., :2]

    names = _Names(np.concatenate([plan(room.outline) for room in graph.rooms if room.floor == floor.id] or [[(0, 0)]]))
    for room in graph.rooms:
        if room.floor != floor.id:
            continue
        x, y = plan(room.outline).T
        axes.fill(x, y, color=CYCLE[room.id % len(CYCLE)], alpha=0.45, linewidth=0)
        x, y = plan(room.center)
        names.take((x, y), "0000 m²", 2.4, centred=True)
        axes.text(x, y, f"{room.id}\n{room.area_m2:.1f} m²", ha="center", va="center", weight="bold")
    for door in graph.doors:
        if door.rooms[0] in floor.rooms:
            x, y = plan(door.center)
            axes.plot(x, y, "o", color="white", markersize=6)
            if names.take((x, y), "0.00 m  ", 1.2):
                axes.annotate(f"{door.width_m:.2f} m", (x, y), (5, 5), textcoords="offset points", fontsize=SMALL_PT)
    for thing in sorted(graph.things, key=lambda thing: -thing.box.size.max()):
        below = [f for f in graph.floors if f.height_m <= thing.centroid @ graph.up + LOW_M[1]] or graph.floors
        room = graph.room_of[thing.id]
        if room in floor.rooms or (room is None and below[-1] == floor):
            x, y = plan(thing.centroid)
            axes.plot(x, y, ".", color="black", markersize=4)
            name = PLAIN_NAMES.get(thing.class_name, thing.class_name)
            if thing.box.size.max() >= NAMED_M and names.take((x, y), name, 0.9):
                axes.annotate(name, (x, y), (2, 2), textcoords="offset points", fontsize=SMALL_PT * 0.7)


class _Names:
    """Where names stand on the plan of a floor, of points (N, 2), so that none covers another; sizes are estimates."""

    def __init__(self, xy: Float64) -> None:
        width, height = np.ptp(xy, axis=0)
        self._letter_m = LETTER_PX * max(width / FLOOR_WIDTH, height / FLOOR_HEIGHT, 1e-3) / PLAN_FRACTION
        self._taken: list[tuple[float, float, float, float]] = []

    def take(self, at: tuple[float, float], text: str, lines: float, *, centred: bool = False) -> bool:
        """Take room for a name next to a point, or around it; False where another name stands there."""
        width, height = self._letter_m * len(text), 2 * self._letter_m * lines
        left, low = (at[0] - width / 2, at[1] - height / 2) if centred else at
        free = all(left >= b[2] or left + width <= b[0] or low >= b[3] or low + height <= b[1] for b in self._taken)
        if free or centred:
            self._taken.append((left, low, left + width, low + height))
        return free
