"""The remembered objects that a phrase means, the likeliest first, and where to look at each from.

The probability of an answer is the product of those of its parts, as if they were independent: its class, each colour,
size, room and relation (softened: there is no sharp end of red or near), and that it is still there."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy  # loads `spatial` when it is first used
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import invert_pose, look_at, transform
from semantic_mapper.labels import STUFF_NAMES
from semantic_mapper.mapping.map_file import open_map
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.checks import check_up
from semantic_mapper.queries.instances import thing_voxels
from semantic_mapper.queries.objects import MapObject, ObjectMemory, brought_up
from semantic_mapper.queries.occupancy import State, read_states
from semantic_mapper.queries.phrase import COLORS, ROOM_KINDS, NounPhrase, read_phrase
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import cast_rays, up_in
from semantic_mapper.queries.text_encoder import TextEncoder
from semantic_mapper.types import Float64, UInt8

LEAST_PROBABILITY = 0.005  # of an answer
COLOR_LIGHTNESS, COLOR_SPREAD = 0.7, 12.0  # weight of lightness, which light changes; CIELAB distance of one sigma
LIGHTEST = 95, 92.0  # percentile of the lightness of things that is taken for this one, as rooms are dark and bright
MIDDLE_LIGHT, SHADE_SPREAD = 55.0, 8.0  # CIELAB lightness
SIZE_SPREAD = 0.12  # logarithm of a ratio of lengths
LENGTHS, LIKELY = ("size", "height", "length"), 0.5  # of ``_sizes``; of the best probability, to be the largest of all
NEAR_M, NEAR_SPREAD_M = 0.7, 0.15  # between surfaces
ON_M, FOOTPRINT_M, ABOVE_M = 0.08, 0.06, 0.4
TOUCH_M, TOUCH_SPREAD_M = 0.12, 0.03  # of a wall or floor
ROOM_UNKNOWN = 0.2  # probability of any room, of what stands in none that is known
ROOM_OF_NO_KIND = 1.0  # weight of evidence, against those of ``ROOM_KINDS``
LOOK_M, EYE_M = (0.5, 2.5), 1.2  # from a thing; height of a camera over the floor
RADIUS_M, BODY_M, FLOORS = 0.25, (0.15, 1.5, 0.1), {"floor", "floormat"}  # of a robot; heights that it takes, step
MARK_RGB = (255, 140, 0)  # edges of the box of a thing in its picture
VIEW_DIRECTIONS, VIEW_DISTANCES, VIEW_RAYS, LEAST_VISIBLE, LEVEL_M = 24, 5, 32, 0.2, 0.15


@dataclass(frozen=True, slots=True, eq=False)
class FoundObject:
    """An answer to a phrase."""

    object: MapObject
    probability: float  # that it is meant, and still there
    parts: Mapping[str, float]  # of which that is the product, by the words or by what they are about
    room_kind: str | None  # likeliest kind of its room, by what stands there; None = of no kind
    T_world_camera: Float64 | None  # (4, 4) from where it is seen, over free floor; None = no such place is known


def find(
    text: str,
    snapshot: MapSnapshot,
    objects: Sequence[MapObject],
    *,
    up: ArrayLike | None = None,
    limit: int = 5,
    encoder: TextEncoder | None = None,
) -> tuple[FoundObject, ...]:
    """The objects of a map that a phrase means, at most ``limit``, the likeliest first; see ``queries.phrase``.

    The day of times without a date is that of the last object seen. ``up``, (3,) in the world, is by default found by
    the floor. Raises MapError: as of ``read_phrase``, a limit below 1, or nobody knows which way is up."""
    if limit < 1:
        raise MapError(f"find: limit is {limit}, at least 1 answer is found")
    axis = up_in(snapshot) if up is None else check_up(up)
    now_ns = max((o.last_seen_ns for o in objects), default=0)
    phrase = read_phrase(text, snapshot.label_set, now_ns, encoder)
    scene = _Scene(snapshot, objects, axis)
    found = list[tuple[float, int, dict[str, float]]]()
    for n, thing in enumerate(objects):
        parts = scene.looks(thing, phrase.thing)
        for room in phrase.rooms:
            parts[f"room {room}" if isinstance(room, int) else room] = scene.in_room(thing, room)
        if not (phrase.after_ns or 0) <= thing.last_seen_ns < (phrase.before_ns or 2**63):
            continue
        parts["there"] = 1.0 if phrase.last else thing.present
        if (probability := float(np.prod(list(parts.values())))) >= LEAST_PROBABILITY:
            found.append((probability, n, parts))
    for relation, noun in phrase.relations:
        fits = scene.related([objects[n] for _, n, _ in found], relation, noun)
        name = f"{relation} {noun.text}"
        found = [(p * fit, n, parts | {name: fit}) for (p, n, parts), fit in zip(found, fits, strict=True)]
        found = [answer for answer in found if answer[0] >= LEAST_PROBABILITY]
    fits = scene.most(phrase.thing, [objects[n] for _, n, _ in found], [p for p, _, _ in found])
    if any(abs(sign) == 2 for _, sign in phrase.thing.sizes):
        found = [(p * fit, n, parts | {"most": fit}) for (p, n, parts), fit in zip(found, fits, strict=True)]
        found = [answer for answer in found if answer[0] >= LEAST_PROBABILITY]
    best = sorted(found, key=lambda f: (-f[0], objects[f[1]].id))[:limit]
    return tuple(
        FoundObject(objects[n], p, parts, scene.kind(objects[n].room), view_of(snapshot, objects[n], axis))
        for p, n, parts in best
    )


def open_objects(path: Path, up: ArrayLike | None = None) -> tuple[MapSnapshot, tuple[MapObject, ...]]:
    """A saved map, and the objects that it remembers; brought up to the present where what it remembers is older.

    Raises MapError: as of ``VoxelMap.load``; no metres; or ``up`` (3,) is not given, and no floor was found."""
    with open_map(path) as reader:
        memory, stamp_ns = ObjectMemory.from_bytes(reader.objects()), reader.manifest.last_stamp_ns
    if len(memory) and memory.last_ns >= stamp_ns:
        return MapMirror.load(path).snapshot(), memory.objects
    voxel_map = VoxelMap.load(path)
    require_metres(voxel_map.scale_known, f"{path}: find")
    if (found := brought_up(voxel_map, up)) is None:
        raise MapError(f"{path}: no floor was found, by which it is known which way is up; --up says so")
    return MapMirror.of(voxel_map).snapshot(), found.objects


class _Scene:
    def __init__(self, snapshot: MapSnapshot, objects: Sequence[MapObject], up: Float64) -> None:
        self._snapshot, self._up = snapshot, up
        self._there = [o for o in objects if o.gone_ns is None]
        self._kinds = room_kinds(self._there)
        lightest = float(np.percentile([_lab(o.color)[0] for o in self._there] or [0.0], LIGHTEST[0]))
        self._gain = LIGHTEST[1] / min(max(lightest, LIGHTEST[1] / 2), LIGHTEST[1])
        sizes = {n: [_sizes(o) for o in self._there if o.class_id == n] for n in {o.class_id for o in self._there}}
        self._medians = {n: np.median(rows, axis=0) for n, rows in sizes.items() if len(rows) > 1}
        labels = snapshot.label_set
        self._stuff = {n: name for n, name in zip(labels.ids, labels.names, strict=True) if name in STUFF_NAMES}

    def looks(self, thing: MapObject, noun: NounPhrase) -> dict[str, float]:
        """How well its class, colour and size fit."""
        parts = {"class": sum(p * noun.classes.get(n, 0.0) for n, p in thing.classes)}
        if noun.colors:
            names = color_names(_lab(thing.color) * self._gain)
            parts["color"] = max(names[name] for name in noun.colors)
        if noun.shade:
            usual = np.mean([_colors()[name][:, 0].mean() for name in noun.colors] or [MIDDLE_LIGHT])
            parts["shade"] = _soft(noun.shade * (_lab(thing.color)[0] * self._gain - usual) / SHADE_SPREAD)
        for what, sign in noun.sizes:
            if abs(sign) == 1:
                median = self._medians.get(thing.class_id, _sizes(thing))
                parts[what] = _soft(sign * (_sizes(thing) - median)[LENGTHS.index(what)] / SIZE_SPREAD)
        return parts

    def most(self, noun: NounPhrase, things: Sequence[MapObject], probabilities: Sequence[float]) -> list[float]:
        """How well things are what a noun wants the most or least of, among the likely ones of them."""
        fits, least = np.ones(len(things)), LIKELY * max(probabilities, default=0.0)
        for what, sign in noun.sizes:
            if abs(sign) == 2 and len(things):
                length = np.array([np.sign(sign) * _sizes(o)[LENGTHS.index(what)] for o in things])
                most = length[np.array(probabilities) >= least].max()
                fits *= np.exp(np.minimum(length - most, 0) / SIZE_SPREAD)
        return fits.tolist()

    def kind(self, room: int | None) -> str | None:
        """Likeliest kind of a room."""
        kinds = self._kinds.get(room or 0, {})
        best = max(kinds, key=lambda name: kinds[name], default="")
        return best or None

    def in_room(self, thing: MapObject, room: int | str) -> float:
        if thing.room is None:
            return ROOM_UNKNOWN
        return float(thing.room == room) if isinstance(room, int) else self._kinds[thing.room].get(room, 0.0)

    def related(self, things: Sequence[MapObject], relation: str, noun: NounPhrase) -> list[float]:
        """How well things stand in a relation to any other that fits a noun."""
        found = self._touch(things, relation, noun)
        fits = [float(np.prod(list(self.looks(o, noun).values()))) for o in self._there]
        fits = [fit * most for fit, most in zip(fits, self.most(noun, self._there, fits), strict=True)]
        for other, fit in [of for of in zip(self._there, fits, strict=True) if of[1] >= LEAST_PROBABILITY]:
            for n, thing in enumerate(things):
                reach = np.linalg.norm(thing.box.size) / 2 + np.linalg.norm(other.box.size) / 2 + 2 * NEAR_M
                near = other.id != thing.id and np.linalg.norm(thing.box.center - other.box.center) < reach
                if near and fit > found[n]:
                    found[n] = max(found[n], fit * self._relation(thing, other, relation))
        return found

    def _touch(self, things: Sequence[MapObject], relation: str, noun: NounPhrase) -> list[float]:
        """Likewise to what is no object, such as walls and the floor."""
        stuff = [n for n in noun.classes if n in self._stuff]
        if not stuff or relation not in ("on", "near"):
            return [0.0] * len(things)
        limit, spread = (TOUCH_M, TOUCH_SPREAD_M) if relation == "on" else (NEAR_M, NEAR_SPREAD_M)
        points = thing_voxels(self._snapshot, np.isin(np.arange(256), stuff)).point[::2]
        tree, found = scipy.spatial.cKDTree(points * self._snapshot.voxel_size_m), list[float]()
        for thing in things:
            xyz, height = thing.surface, thing.surface @ self._up
            if {self._stuff[n] for n in stuff} <= FLOORS:  # what hangs low at a wall is not on the floor
                xyz = xyz[height <= height.min() + TOUCH_M]
            distance = tree.query(xyz, distance_upper_bound=limit + 6 * spread)[0].min()
            found.append(_soft((limit - distance) / spread))
        return found

    def _relation(self, thing: MapObject, other: MapObject, relation: str) -> float:
        up, surface = self._up, thing.surface
        (low, high), (other_low, other_high) = (
            (float(o.box.center @ up - o.box.size[2] / 2), float(o.box.center @ up + o.box.size[2] / 2))
            for o in (thing, other)
        )
        offset = _outside(other, thing.box.center[None])[0]
        aside = float(np.linalg.norm(offset - (offset @ up) * up))  # of its middle, from the other's outline
        match relation:
            case "near":
                return _soft((NEAR_M - np.linalg.norm(_outside(other, surface), axis=1).min()) / NEAR_SPREAD_M)
            case "on":
                points = other.surface
                level = (points - thing.box.center) @ (np.eye(3) - np.outer(up, up))
                heights = points[np.linalg.norm(level, axis=1) < np.linalg.norm(thing.box.size[:2]) / 2 + 0.1] @ up
                held = heights[heights < low + 2 * ON_M]
                top = float(held.max()) if len(held) else other_high
                over = low > other_low + ON_M
                return over * float(np.exp(-(((low - top) / ON_M) ** 2) / 2)) * _soft(2 - aside / FOOTPRINT_M)
            case "under":
                return _soft((other_low + other_high - low - high) / 2 / FOOTPRINT_M) * _soft(2 - aside / FOOTPRINT_M)
            case "above":
                return _soft((low - other_high) / FOOTPRINT_M + 2) * _soft((ABOVE_M - aside) / FOOTPRINT_M)
            case _:  # in
                return _soft(2 - float(np.linalg.norm(offset)) / (FOOTPRINT_M / 2))


def room_kinds(objects: Sequence[MapObject]) -> dict[int, dict[str, float]]:
    """Probabilities of the kinds of rooms, by id of the room; "" = none of them."""
    rooms = dict[int, dict[str, float]]()
    for thing in objects:
        if thing.room is not None:
            there = rooms.setdefault(thing.room, {})
            there[thing.class_name] = max(there.get(thing.class_name, 0.0), thing.probability)
    found = dict[int, dict[str, float]]()
    for room, there in rooms.items():
        odds = {k: sum(w * there.get(n, 0.0) for n, w in names.items()) for k, names in ROOM_KINDS.items()}
        odds[""] = ROOM_OF_NO_KIND
        total = sum(np.exp(v) for v in odds.values())
        found[room] = {name: float(np.exp(v) / total) for name, v in odds.items()}
    return found


def color_names(lab: Float64) -> dict[str, float]:
    """Probability of each name of ``COLORS`` for a colour (3,) in CIELAB."""
    scale = np.array((COLOR_LIGHTNESS, 1, 1)) / COLOR_SPREAD
    distance = {name: (((known - lab) * scale) ** 2).sum(axis=1).min() for name, known in _colors().items()}
    odds = {name: float(np.exp(-(d - min(distance.values())) / 2)) for name, d in distance.items()}
    return {name: value / sum(odds.values()) for name, value in odds.items()}


def _lab(rgb: UInt8) -> Float64:
    """CIELAB (..., 3) of sRGB (..., 3)."""
    pixels = rgb.reshape(1, -1, 3).astype(np.float32) / np.float32(255)
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB).reshape(rgb.shape).astype(np.float64)


@functools.cache
def _colors() -> dict[str, Float64]:
    """``COLORS`` (K, 3) in CIELAB, by name."""
    return {n: _lab(np.array([[*bytes.fromhex(c)] for c in codes.split()], np.uint8)) for n, codes in COLORS.items()}


def _sizes(thing: MapObject) -> Float64:
    """Logarithms of its diagonal, height and longest level side."""
    size = np.maximum(thing.box.size, 0.01)
    return np.log((np.linalg.norm(size), size[2], max(size[:2])))


def _outside(thing: MapObject, points: Float64) -> Float64:
    """From the box of a thing to points (N, 3): vectors (N, 3) in the world, 0 inside."""
    own = (points - thing.box.center) @ thing.box.R_world_box
    half = thing.box.size / 2
    return (own - np.clip(own, -half, half)) @ thing.box.R_world_box.T


def _soft(x: float | np.floating) -> float:
    return float(1 / (1 + np.exp(-np.clip(x, -30, 30))))


def view_of(snapshot: MapSnapshot, thing: MapObject, up: Float64) -> Float64 | None:
    """Pose (4, 4) of a camera over floor that was seen, with room for a robot round it, from where most of a thing is
    seen; None where no such place is known."""
    R, size = thing.box.R_world_box, thing.box.size
    angle = np.linspace(0, 2 * np.pi, VIEW_DIRECTIONS, endpoint=False)[:, None]
    apart = np.linspace(*LOOK_M, VIEW_DISTANCES) + np.linalg.norm(size[:2]) / 2
    level = (np.cos(angle) * R[:, 0] + np.sin(angle) * R[:, 1])[:, None] * apart[:, None]
    start = (thing.box.center + level).reshape(-1, 3) + (EYE_M - size[2] / 2) * up
    down = cast_rays(snapshot, start, -up, 2 * EYE_M + 2)
    names = dict(zip(snapshot.label_set.ids, snapshot.label_set.names, strict=True))
    floor = np.isin(down.label, [n for n, name in names.items() if name in FLOORS]) & (down.distance_m > 0)
    foot = (start - down.distance_m[:, None] * up)[floor]
    if not len(foot):
        return None
    rim = RADIUS_M * (np.cos(angle) * R[:, 0] + np.sin(angle) * R[:, 1])
    body = (rim[::2, None] + np.arange(*BODY_M)[:, None] * up).reshape(-1, 3)
    states = read_states((foot[:, None] + body).reshape(-1, 3) / snapshot.voxel_size_m, snapshot)
    level_m = np.abs((foot - np.median(foot, axis=0)) @ up) < LEVEL_M  # else on what is wrongly labelled floor
    eyes = foot[level_m & (states.reshape(len(foot), -1) < State.OCCUPIED).all(axis=1)] + EYE_M * up
    if not len(eyes):
        return None
    surface = thing.surface[:: 1 + len(thing.points) // VIEW_RAYS]
    rays = surface - eyes[:, None]  # (E, S, 3)
    length = np.linalg.norm(rays, axis=-1)
    origins = np.repeat(eyes, len(surface), axis=0)
    hit = cast_rays(snapshot, origins, rays.reshape(-1, 3), float(length.max()) + 0.5).distance_m.reshape(length.shape)
    visible = (np.abs(hit - length) < 3 * snapshot.voxel_size_m).mean(axis=1)
    best = int((visible - 0.1 * np.abs(length.mean(axis=1) - sum(LOOK_M) / 2)).argmax())
    return look_at(eyes[best], thing.box.center, up) if visible[best] >= LEAST_VISIBLE else None


def render(snapshot: MapSnapshot, T_world_camera: Float64, width: int = 320, fov_rad: float = 1.2) -> UInt8:
    """What a camera would see of a map: (3/4 width, width, 3) uint8, light grey where nothing is mapped."""
    height = width * 3 // 4
    v, u = np.indices((height, width), np.float64)
    focal = width / 2 / np.tan(fov_rad / 2)
    rays = np.stack(((u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones_like(u)), axis=-1)
    hits = cast_rays(snapshot, T_world_camera[:3, 3], rays.reshape(-1, 3) @ T_world_camera[:3, :3].T)
    return np.where(hits.distance_m[:, None] > 0, hits.rgb, np.uint8(230)).reshape(height, width, 3)


def picture_of(snapshot: MapSnapshot, found: FoundObject, up: Float64, width: int = 320) -> UInt8:
    """A crop (H, W, 3) uint8 round an object and its box, from where ``found`` says, or over the side that was seen."""
    box = found.object.box
    size = float(np.linalg.norm(box.size))
    T = found.T_world_camera
    if T is None:
        angle = np.linspace(0, 2 * np.pi, VIEW_DIRECTIONS, endpoint=False)[:, None]
        ways = np.sin(angle) * box.R_world_box[:, 0] + np.cos(angle) * box.R_world_box[:, 1] + 0.7 * up
        before = found.object.surface / snapshot.voxel_size_m + 3 * ways[:, None] / np.linalg.norm(ways[0])
        free = read_states(before.reshape(-1, 3), snapshot).reshape(len(ways), -1) == State.FREE
        way = ways[free.sum(axis=1).argmax()]  # the side that was seen
        T = look_at(box.center + (size + 0.5) * way, box.center, up)
    distance = float(np.linalg.norm(T[:3, 3] - box.center))
    fov_rad = 2 * float(np.arctan(0.8 * size / distance))
    picture = np.ascontiguousarray(render(snapshot, T, width, fov_rad))
    corners = (np.array([*np.ndindex(2, 2, 2)]) - 0.5) * box.size @ box.R_world_box.T + box.center
    seen = transform(invert_pose(T), corners)
    middle = (np.array(picture.shape[1::-1]) - 1) / 2
    uv = seen[:, :2] / np.maximum(seen[:, 2:], 0.05) * width / 2 / np.tan(fov_rad / 2) + middle
    ends = np.clip(np.round(uv), -(1 << 15), 1 << 15).astype(int).tolist()
    for one, other in itertools.combinations(range(8), 2):
        if (one ^ other).bit_count() == 1:  # an edge of the box
            cv2.line(picture, ends[one], ends[other], MARK_RGB, max(1, width // 320), cv2.LINE_AA)
    return picture
