"""Objects with a memory: things of a map that keep their id over visits, when they are moved, and in saved maps."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import CodecError, MapError
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.localization.places import shared_places
from semantic_mapper.mapping.map_alignment import AlignmentError, find_alignment
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.graph import GraphTracker, SceneGraph
from semantic_mapper.queries.instances import OrientedBox, upright_box
from semantic_mapper.queries.phrase import has_date
from semantic_mapper.queries.revisit import (
    FIXTURES,
    GONE_FREE,
    LEAST_SHIFT_M,
    SHIFTED_FREE,
    SIGNATURE,
    Candidate,
    Evidence,
    Fit,
    Looks,
    MapVisit,
    color_of,
    find_evidence,
    joined,
    lies_along,
    match_candidates,
    may_go,
    overlapping,
    parted,
    sample_points,
    signature_of,
    touching,
)
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.transport.images import zstd_compress, zstd_decompress
from semantic_mapper.types import Float64, UInt8

MAX_OBJECTS = 10_000
MAX_PLACES = 4  # that an object keeps of its history
MAX_CLASSES = 4  # that an object keeps the probabilities of
POINTS = 96  # of its surface that an object keeps, at most
MAX_BYTES = 50 << 20  # of a memory in a file, unpacked
NEVER_NS = -(2**63)
MEMORY_VIEWS = 9  # that the probabilities of classes are averaged over, at most

Kind = Literal["moved", "new", "gone"]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPlace:
    """Where an object was from a time on."""

    stamp_ns: int  # first seen here
    box: OrientedBox
    room: int | None  # id of the room, as of ``SceneGraph``; None = not known


@dataclass(frozen=True, slots=True, eq=False)
class MapObject:
    """A thing that is remembered."""

    id: int  # above 0; never given to another, and stays with the thing when it is moved, and in saved maps
    class_id: int  # the likeliest
    class_name: str
    # (class id, probability), the likeliest first; at most ``MAX_CLASSES``; they sum to 1 or less
    classes: tuple[tuple[int, float], ...]
    box: OrientedBox  # of where it is, or was last
    color: UInt8  # (3,) uint8 mean RGB of its surface
    signature: NDArray[np.int8] = field(repr=False)  # (SIGNATURE,) int8, what it looks like; see ``signature_of``
    points: NDArray[np.int16] = field(repr=False)  # (N, 3) int16 of its surface, millimetres from the box's centre
    first_seen_ns: int  # as ``last_seen_ns``, at the first update
    last_seen_ns: int  # stamp of the last frame by which enough of it had been seen again
    views: int  # updates of the memory in which it was seen
    room: int | None  # where it is, or was last
    places: tuple[ObjectPlace, ...]  # where it was, the oldest first; the last is the present one
    missed: int = 0  # views of its place since in which it was not to be seen
    gone_ns: int | None = None  # when its place was first seen without it; None = it is there
    appeared: bool = False  # whether its first place had been seen without it before
    certainty: float = 1.0  # probability of its last change: that it was moved, has gone or came
    seen: float = 1.0  # fraction of its outside that was seen, at best; its signature is of then

    @property
    def surface(self) -> Float64:
        """(N, 3) float64 points of its surface, world metres."""
        return self.box.center + self.points / 1000.0

    @property
    def present(self) -> float:
        """Probability that it is still there: of what has gone, that this is wrong; else each view of its place since
        without it counts as much as the one that saw it. Time alone changes nothing."""
        return 1 / (1 + self.missed) if self.gone_ns is None else 1 - self.certainty

    @property
    def probability(self) -> float:
        """Of the likeliest class."""
        return self.classes[0][1]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectChange:
    """What became of one object between two visits."""

    kind: Kind
    object: MapObject  # as it is now; of what has gone, as it was
    before: ObjectPlace | None  # where it was before; None of what is new
    probability: float  # that the change is real


class _Rows(msgspec.Struct, frozen=True, array_like=True):
    next_id: Annotated[int, msgspec.Meta(ge=1)]
    objects: Annotated[tuple[MapObject, ...], msgspec.Meta(max_length=MAX_OBJECTS)]
    last_ns: int = NEVER_NS


class ObjectMemory:
    """The objects of one map, by id; those that have gone, too.

    Beyond ``MAX_OBJECTS``, first gone are first forgotten, then those seen least. MapError: an id comes twice."""

    def __init__(self, objects: Iterable[MapObject] = (), next_id: int = 1, last_ns: int = NEVER_NS) -> None:
        self._objects: dict[int, MapObject] = {}
        for thing in objects:
            if thing.id in self._objects:
                raise MapError(f"object memory: id {thing.id} comes twice")
            self._objects[thing.id] = thing
        self._next_id = max((next_id, *(number + 1 for number in self._objects)))
        self._last_ns = last_ns

    def __len__(self) -> int:
        return len(self._objects)

    @property
    def objects(self) -> tuple[MapObject, ...]:
        """All, by ascending id."""
        return tuple(self._objects[number] for number in sorted(self._objects))

    @property
    def there(self) -> tuple[MapObject, ...]:
        """Those that have not gone, by ascending id."""
        return tuple(thing for thing in self.objects if thing.gone_ns is None)

    def get(self, number: int) -> MapObject | None:
        """The object of an id; None where no object has it, or it was forgotten."""
        return self._objects.get(number)

    def update(
        self,
        now: MapVisit,
        up: Float64,
        rooms: Mapping[int, int | None] = MappingProxyType({}),
        before: MapVisit | None = None,
    ) -> None:
        """Take over what is seen now. ``FIXTURES`` are never reported as moved, gone or new.

        Args:
            now: The map as it is, its things, and the views since the last update.
            up: (3,) unit vector, along which boxes stand.
            rooms: Id of the room of each thing, by id of the thing.
            before: The map of the last visit and its views, in the same world; without it nothing is known to be new,
                and surfaces are not fitted to each other.
        """
        stamp_ns, old = now.stamp_ns, list(self.there)
        fit = Fit(None if before is None else before.snapshot, now.snapshot)
        taken = list[MapObject]()  # parts of objects that may have left, without ids yet
        if before is not None:
            wholes, parts = parted(now, before, lambda xyz: transform(invert_pose(fit.at(xyz.mean(axis=0))), xyz), up)
            now = now._replace(things=[*wholes, *(part for part, _ in parts)])
            taken = self._taken_parts(before, now, fit, up)
        came_free = self._came(now, before, fit)
        if before is not None:
            now, came_free = _joined(now, came_free)
        points = [sample_points(thing, now.snapshot) for thing in now.things]
        same = overlapping([o.surface for o in old], points, lambda i, j: old[i].class_id == now.things[j].class_id)
        goers, missed = self._goers(old, now, fit)
        began = stamp_ns if before is None else before.stamp_ns
        still = {j for i, j in same if before is None or old[i].places[-1].stamp_ns > began}
        for i in [i for i, goer in goers.items() if goer.free < GONE_FREE]:
            surface = transform(fit.at(old[i].box.center), old[i].surface)
            kin = [j for j, t in enumerate(now.things) if t.class_id == old[i].class_id and came_free[j] < GONE_FREE]
            if stood := {j for j in kin if lies_along(surface, points[j])}:
                still |= stood
                del goers[i]
        comers = dict[int, Candidate]()
        for j, thing in enumerate(now.things):
            if j not in still and came_free[j] >= SHIFTED_FREE:
                looks = signature_of(now.snapshot, thing, up), color_of(now.snapshot, thing)
                centers = np.stack((points[j].mean(axis=0), thing.box.center))
                comers[j] = Candidate(thing.class_id, thing.box.size, centers, came_free[j], *looks)
        away = [o for o in self.objects if o.gone_ns is not None]
        rows = [*goers.values(), *(_candidate(o, np.eye(4), 1.0) for o in (*taken, *away))]
        sources, targets = [*(old[i] for i in goers), *taken, *away], list(comers)
        left, came = set[int](), set[int]()
        for r, c, probability in match_candidates(rows, list(comers.values())):
            thing, j = self._with_id(sources[r]), targets[c]
            if sources[r] in taken:
                taken.remove(sources[r])
            moved = _refreshed(thing, now, j, up, rooms)
            place = ObjectPlace(stamp_ns, moved.box, moved.room)
            places = (*thing.places, place)[-MAX_PLACES:]
            moved = replace(moved, places=places, missed=0, gone_ns=None, certainty=probability)
            self._objects[thing.id] = moved
            left.add(thing.id)
            came.add(j)
        for i, goer in goers.items():
            thing = old[i]
            if thing.id not in left and goer.free >= GONE_FREE:
                self._objects[thing.id] = replace(
                    thing, gone_ns=stamp_ns, missed=thing.missed + max(1, missed[i]), certainty=goer.free
                )
                left.add(thing.id)
            elif thing.id not in left and missed[i]:
                self._objects[thing.id] = replace(thing, missed=thing.missed + missed[i])
        there = [o.box for o in old if o.id in left]
        for part in taken:
            if any(len(touching([part.box, box])) == 1 for box in there):  # a part of what left
                continue
            thing = self._with_id(part)
            self._objects[thing.id] = replace(thing, gone_ns=stamp_ns, missed=1)
        for i, j in same:
            if old[i].id in self._objects and old[i].id not in left and j not in came:
                self._objects[old[i].id] = _refreshed(old[i], now, j, up, rooms)
                came.add(j)
        self._last_ns = max(self._last_ns, stamp_ns)
        for j in range(len(now.things)):
            if j not in came:
                appeared = before is not None and j in comers and comers[j].free >= GONE_FREE
                made = _remembered(self._next_id, now, j, up, rooms)
                certainty = comers[j].free if appeared else 1.0
                self._objects[made.id] = replace(made, appeared=appeared, certainty=certainty)
                self._next_id += 1
        self._forget()

    def _goers(self, old: list[MapObject], now: MapVisit, fit: Fit) -> tuple[dict[int, Candidate], dict[int, int]]:
        """Those of some objects that may have left, and how many views see each one's place without it, by position.
        Pieces that left together are one object from now on, also in ``old``, with the id of the largest."""
        evidence = dict[int, Evidence]()
        for i, thing in enumerate(old):
            if not may_go(thing.box, len(thing.points)):
                continue
            T = partial(fit.at, thing.box.center)
            evidence[i] = find_evidence(
                now, thing.class_id, thing.surface, lambda T=T, o=thing: transform(T(), o.surface)
            )
        left = [i for i, e in evidence.items() if old[i].class_name not in FIXTURES and e.free_of >= SHIFTED_FREE]
        whole = [i for i in left if evidence[i].free_of >= GONE_FREE]
        for group in touching([old[i].box for i in whole], [old[i].class_id for i in whole]):
            first, *others = sorted((whole[k] for k in group), key=lambda i: -float(np.prod(old[i].box.size)))
            for i in others:
                left.remove(i)
                del self._objects[old[i].id]
            if others:
                old[first] = self._objects[old[first].id] = _as_one([old[i] for i in (first, *others)])
        found = {i: _candidate(old[i], fit.at(old[i].box.center), evidence[i].free_of) for i in left}
        return found, {i: e.looks for i, e in evidence.items()}

    def _came(self, now: MapVisit, before: MapVisit | None, fit: Fit) -> list[float]:
        """How much of the place of each thing of now was free before; without a map of before, all."""
        free = list[float]()
        for thing in now.things:
            points = sample_points(thing, now.snapshot)
            if before is None or thing.class_name in FIXTURES or not may_go(thing.box, len(thing.voxels)):
                free.append(0.0 if before is not None else 1.0)
                continue
            T = partial(fit.at, points.mean(axis=0))
            free.append(
                find_evidence(
                    before, thing.class_id, points, lambda T=T, p=points: transform(invert_pose(T()), p)
                ).free_of
            )
        return free

    def _with_id(self, thing: MapObject) -> MapObject:
        """An object that has its id, a new one where it had none."""
        if not thing.id:
            thing = replace(thing, id=self._next_id)
            self._next_id += 1
        return thing

    def _taken_parts(self, before: MapVisit, now: MapVisit, fit: Fit, up: Float64) -> list[MapObject]:
        """Parts of things of before that are free now, as objects without an id (0)."""
        _, parts = parted(before, now, lambda xyz: transform(fit.at(xyz.mean(axis=0)), xyz), up)
        from_parts = before._replace(things=[part for part, _ in parts])
        return [_remembered(0, from_parts, k, up, {}) for k in range(len(parts))]

    @property
    def last_ns(self) -> int:
        """Stamp of the last update; the least stamp of an empty memory."""
        return max((self._last_ns, *(thing.last_seen_ns for thing in self._objects.values())))

    def moved_by(self, T_new_old: Float64, later_ns: int = 0) -> ObjectMemory:
        """The same objects where the world is another one, at ``T_new_old`` (4, 4), and stamps are later."""
        moved = (_moved_by(thing, T_new_old, later_ns) for thing in self._objects.values())
        return ObjectMemory(moved, self._next_id, NEVER_NS if self._last_ns == NEVER_NS else self._last_ns + later_ns)

    def join(self, other: ObjectMemory) -> None:
        """Take over the objects of another map of the same world. What is there in both, at one place and of one class,
        is one object, with the id of here; others get new ids."""
        self._last_ns = max(self._last_ns, other.last_ns)
        ours, theirs = self.there, other.objects
        there = [k for k, thing in enumerate(theirs) if thing.gone_ns is None]
        points = [theirs[k].surface for k in there]
        pairs = overlapping(
            [o.surface for o in ours], points, lambda i, j: ours[i].class_id == theirs[there[j]].class_id
        )
        same = {there[j]: ours[i] for i, j in pairs}
        for k, thing in enumerate(theirs):
            if (known := same.get(k)) is None:
                self._objects[self._next_id] = replace(thing, id=self._next_id)
                self._next_id += 1
                continue
            later = max(known, thing, key=lambda o: o.last_seen_ns)
            earlier = min(known, thing, key=lambda o: o.first_seen_ns)
            began = min(o.places[-1].stamp_ns for o in (known, thing))  # both have it at one place
            self._objects[known.id] = replace(
                later,
                id=known.id,
                first_seen_ns=earlier.first_seen_ns,
                appeared=earlier.appeared,
                places=(*earlier.places[:-1], replace(later.places[-1], stamp_ns=began)),
                views=known.views + thing.views,
                missed=known.missed + thing.missed,
            )
        self._forget()

    def put_in_rooms(self, room_of: Callable[[Float64], int | None]) -> None:
        """Say in which rooms all are and were; ``room_of`` as of ``GraphTracker.room_of``."""
        for thing in self._objects.values():
            rooms = [room_of(thing.surface - thing.box.center + place.box.center) for place in thing.places]
            places = tuple(replace(p, room=room) for p, room in zip(thing.places, rooms, strict=True))
            self._objects[thing.id] = replace(thing, room=rooms[-1], places=places)

    def to_bytes(self) -> bytes:
        """For a file; see ``from_bytes``."""
        content = msgspec.msgpack.encode(_Rows(self._next_id, self.objects, self._last_ns), enc_hook=_pack)
        return struct.pack("<I", len(content)) + zstd_compress(content)

    @classmethod
    def from_bytes(cls, data: bytes) -> ObjectMemory:
        """What ``to_bytes`` made, empty of no bytes. Raises MapError: it is damaged."""
        if not data:
            return cls()
        try:
            (size,) = struct.unpack_from("<I", data)
            if size > MAX_BYTES:
                raise MapError(f"object memory: {size} bytes, at most {MAX_BYTES} are read")
            content = zstd_decompress(data[4:], size, "object memory")
            rows = msgspec.msgpack.decode(content, type=_Rows, dec_hook=_unpack)
            whole = all(o.id > 0 and o.classes and o.places and o.signature.shape == (SIGNATURE,) for o in rows.objects)
            boxes = [box for o in rows.objects for box in (o.box, *(place.box for place in o.places))]
            parts = [part.ravel() for box in boxes for part in (box.center, box.size, box.R_world_box)]
            whole &= bool(np.isfinite(np.concatenate((*parts, np.zeros(1)))).all())
        except (CodecError, struct.error, msgspec.DecodeError, ValueError, TypeError) as error:
            raise MapError(f"object memory is damaged: {error}") from error
        if not whole:
            raise MapError("object memory is damaged: of an object its id, classes, places or looks are missing")
        return cls(rows.objects, rows.next_id, rows.last_ns)

    def _forget(self) -> None:
        excess = len(self._objects) - MAX_OBJECTS
        if excess > 0:
            latest = 2**63
            ordered = sorted(
                self._objects.values(), key=lambda o: (latest if o.gone_ns is None else o.gone_ns, o.views, -o.id)
            )
            for thing in ordered[:excess]:
                del self._objects[thing.id]


def _candidate(thing: MapObject, T_now_then: Float64, free: float) -> Candidate:
    """What was there and may be so no longer; ``free`` as of ``Candidate``."""
    centers = transform(T_now_then, np.stack((thing.surface.mean(axis=0), thing.box.center)))
    return Candidate(
        thing.class_id, thing.box.size, centers, free, thing.signature, thing.color, thing.gone_ns is not None
    )


def _joined(now: MapVisit, free: list[float]) -> tuple[MapVisit, list[float]]:
    """Small things of which pieces came together as one each, and how much of the place of each was free."""
    whole = [j for j, f in enumerate(free) if f >= GONE_FREE]
    things = [now.things[j] for j in whole]
    pieces = touching([thing.box for thing in things], [thing.class_id for thing in things])
    groups = [[whole[k] for k in g] for g in pieces if len(g) > 1]
    gone = {j for group in groups for j in group}
    kept = [j for j in range(len(free)) if j not in gone]
    ones = [joined([now.things[j] for j in group], now.snapshot.voxel_size_m) for group in groups]
    things = [*(now.things[j] for j in kept), *ones]
    return now._replace(things=things), [*(free[j] for j in kept), *(max(free[j] for j in g) for g in groups)]


def _as_one(pieces: Sequence[MapObject]) -> MapObject:
    """Pieces of one object, the largest first, as it."""
    largest, points = pieces[0], np.concatenate([piece.surface for piece in pieces])
    box, weights = upright_box(points, largest.box.R_world_box), [float(np.prod(p.box.size)) for p in pieces]
    looks = np.average([p.signature for p in pieces], axis=0, weights=weights)
    return replace(
        largest,
        box=box,
        color=np.average([p.color for p in pieces], axis=0, weights=weights).astype(np.uint8),
        signature=looks.round().astype(np.int8),
        points=_millimetres(points[:: -(-len(points) // POINTS)] - box.center),
        places=(*largest.places[:-1], replace(largest.places[-1], box=box)),
    )


def remember(voxel_map: VoxelMap, before: MapVisit | None = None, up: ArrayLike | None = None) -> SceneGraph | None:
    """The graph of a finished map, with its things taken over into what the map remembers (``VoxelMap.objects``); None,
    and nothing is taken over, where its lengths are not metres, or ``up`` (3,) is not given and no floor is known.
    ``before`` as of ``ObjectMemory.update``. Raises MapError: what the map remembers is damaged."""
    memory = ObjectMemory.from_bytes(voxel_map.objects)
    if not voxel_map.scale_known:
        return None
    tracker = GraphTracker(up)
    try:
        if before is not None:
            graph = tracker.update(before.snapshot)
            before = before._replace(things=graph.things)
            if not len(memory):
                memory.update(before, graph.up, graph.room_of)
        snapshot = MapMirror.of(voxel_map).snapshot()
        graph = tracker.update(snapshot)
    except MapError:
        return None
    bring_up(voxel_map, memory, snapshot, graph, before)
    return graph


def brought_up(voxel_map: VoxelMap, up: ArrayLike | None = None) -> ObjectMemory | None:
    """What a loaded map remembers, brought up to the present where that is older; None as of ``remember``."""
    memory = ObjectMemory.from_bytes(voxel_map.objects)
    if len(memory) and memory.last_ns >= voxel_map.last_stamp_ns:
        return memory
    voxel_map.objects_version = 0  # when it changed is not in the file
    return None if remember(voxel_map, None, up) is None else ObjectMemory.from_bytes(voxel_map.objects)


def bring_up(
    voxel_map: VoxelMap, memory: ObjectMemory, snapshot: MapSnapshot, graph: SceneGraph, before: MapVisit | None
) -> None:
    """Take the things of a state of a map, which its ``graph`` has, over into what the map remembers, ``memory``."""
    looks = Looks.of(voxel_map.places.places, memory.last_ns)
    changed = voxel_map.changed_stamps(voxel_map.objects_version if len(memory) else -1)
    now = MapVisit(snapshot, graph.things, looks, voxel_map.last_stamp_ns, changed)
    memory.update(now, graph.up, graph.room_of, before)
    voxel_map.objects, voxel_map.objects_version = memory.to_bytes(), snapshot.version


def visit_of(voxel_map: VoxelMap) -> MapVisit:
    """A map as it is now and all views that it keeps, without its things."""
    places = voxel_map.places.places
    return MapVisit(MapMirror.of(voxel_map).snapshot(), (), Looks.of(places), voxel_map.last_stamp_ns)


def changes_of(objects: Iterable[MapObject], since_ns: int) -> tuple[ObjectChange, ...]:
    """What has become of objects after a stamp, the surest first."""
    found: list[ObjectChange] = []
    for thing in objects:
        known = thing.first_seen_ns <= since_ns
        then = [thing.places[0], *(place for place in thing.places if place.stamp_ns <= since_ns)][-1]
        elsewhere = np.linalg.norm(thing.places[-1].box.center - then.box.center) >= LEAST_SHIFT_M  # it may be back
        if known and thing.gone_ns is not None and thing.gone_ns > since_ns:
            found.append(ObjectChange("gone", thing, then, thing.certainty))
        elif known and thing.gone_ns is None and thing.places[-1].stamp_ns > since_ns and elsewhere:
            found.append(ObjectChange("moved", thing, then, thing.certainty))
        elif not known and thing.gone_ns is None and thing.appeared:
            found.append(ObjectChange("new", thing, None, thing.certainty))
    return tuple(sorted(found, key=lambda change: (-change.probability, change.object.id)))


def changes_between(
    now: VoxelMap, before: VoxelMap, up: ArrayLike | None = None
) -> tuple[tuple[ObjectChange, ...], VoxelMap]:
    """What has become of the things of a map of before in a later one, which goes on in it or is of the same place; and
    the map of before, in the world of the later one.

    Maps without a common frame are first aligned by their places. What ``now`` remembers counts where it goes on in
    ``before``; else it then remembers what this finds. Where stamps do not say that ``before`` is the earlier one, as
    those that count from a robot's start, its stamps (and those of what it remembers) become ones before ``now``'s
    first. ``up``, (3,) in the world of ``now``, is by default found by the floor. Raises MapError: the maps have other
    classes or do not fit each other, nobody knows how they lie, or no metres or floor are known.
    """
    require_metres(now.scale_known, "changes")
    if now.label_set != before.label_set:
        names = now.label_set.name, before.label_set.name
        raise MapError("changes: the map has classes of {!r}, the earlier one others, of {!r}".format(*names))
    ours, theirs = (ObjectMemory.from_bytes(m.objects) for m in (now, before))
    if len(theirs) and all((o := ours.get(t.id)) and o.first_seen_ns == t.first_seen_ns for t in theirs.objects):
        return changes_of(ours.objects, before.last_stamp_ns), before
    later_ns, T = 0, np.eye(4)
    if now.last_stamp_ns <= before.last_stamp_ns:
        if has_date(now.last_stamp_ns):
            raise MapError(
                "changes: the map of before is the later one by its dates; give the maps the other way round"
            )
        first_ns = min((p.stamp_ns for p in now.places.places), default=now.last_stamp_ns)
        later_ns = first_ns - 1 - before.last_stamp_ns
    if not shared_places(now.places.places, before.places.places):
        try:
            T = find_alignment(now, before).T_map_other
        except AlignmentError as error:
            raise MapError(f"changes: {error}; go on in the map of before: `up --set mapper.map=FILE`") from error
        aligned = VoxelMap(now.config, now.label_set)
        aligned.add(before, T)
        before = aligned
    before.last_stamp_ns += later_ns
    now.objects, now.objects_version = theirs.moved_by(T, later_ns).to_bytes(), 0
    if remember(now, visit_of(before), up) is None:
        raise MapError("changes: no floor was found, by which it is known which way is up; --up says so")
    return changes_of(ObjectMemory.from_bytes(now.objects).objects, before.last_stamp_ns), before


def _moved_by(thing: MapObject, T: Float64, later_ns: int) -> MapObject:
    R = T[:3, :3]

    def moved(box: OrientedBox) -> OrientedBox:
        return OrientedBox(transform(T, box.center), box.size, R @ box.R_world_box)

    places = tuple(replace(p, box=moved(p.box), stamp_ns=p.stamp_ns + later_ns) for p in thing.places)
    return replace(
        thing,
        box=moved(thing.box),
        places=places,
        points=_millimetres(thing.points @ R.T / 1000),
        first_seen_ns=thing.first_seen_ns + later_ns,
        last_seen_ns=thing.last_seen_ns + later_ns,
        gone_ns=None if thing.gone_ns is None else thing.gone_ns + later_ns,
    )


def _remembered(number: int, now: MapVisit, j: int, up: Float64, rooms: Mapping[int, int | None]) -> MapObject:
    """A thing of now as a new object."""
    thing, snapshot = now.things[j], now.snapshot
    seen_ns = now.stamp_ns if (seen := now.seen_ns(thing)) is None else seen
    room = rooms.get(thing.id)
    return MapObject(
        id=number,
        class_id=thing.class_id,
        class_name=thing.class_name,
        classes=((thing.class_id, thing.confidence),),
        box=thing.box,
        color=color_of(snapshot, thing),
        signature=signature_of(snapshot, thing, up),
        points=_millimetres(sample_points(thing, snapshot, POINTS) - thing.box.center),
        first_seen_ns=seen_ns,
        last_seen_ns=seen_ns,
        views=1,
        room=room,
        places=(ObjectPlace(now.stamp_ns, thing.box, room),),
        seen=thing.seen,
    )


def _millimetres(offsets: Float64) -> NDArray[np.int16]:
    """Metres (N, 3) as they are kept; what is farther than 32 m from the middle of a thing is kept there."""
    return np.clip(np.round(offsets * 1000), -32767, 32767).astype(np.int16)


def _refreshed(old: MapObject, now: MapVisit, j: int, up: Float64, rooms: Mapping[int, int | None]) -> MapObject:
    """An object that is seen as a thing of now; at the place of before, as far as its history goes."""
    made, weight = _remembered(old.id, now, j, up, rooms), min(old.views, MEMORY_VIEWS)
    odds = {number: p * weight for number, p in old.classes}
    odds[made.class_id] = odds.get(made.class_id, 0.0) + made.probability
    classes = sorted(((n, p / (weight + 1)) for n, p in odds.items()), key=lambda c: -c[1])[:MAX_CLASSES]
    likeliest = classes[0][0]
    names = {old.class_id: old.class_name, made.class_id: made.class_name}
    labels = now.snapshot.label_set
    best = made if made.seen >= old.seen else old
    seen_ns = now.seen_ns(now.things[j])
    place = ObjectPlace(old.places[-1].stamp_ns, made.box, made.room)
    return replace(
        made,
        class_id=likeliest,
        class_name=names.get(likeliest) or labels.names[labels.ids.index(likeliest)],
        classes=tuple(classes),
        signature=best.signature,
        color=best.color,
        first_seen_ns=old.first_seen_ns,
        last_seen_ns=old.last_seen_ns if seen_ns is None else max(seen_ns, old.last_seen_ns),
        views=old.views + (seen_ns is not None),
        places=(*old.places[:-1], place),
        appeared=old.appeared,
        certainty=old.certainty,
        seen=best.seen,
    )


def _pack(value: object) -> object:
    """An array as its shape and bytes; only little-endian machines run this."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"no file holds a {type(value).__name__}")
    return value.shape, value.tobytes()


def _unpack(annotation: Any, value: Any) -> NDArray[np.generic]:
    shape, data = value
    return np.frombuffer(data, get_args(get_args(annotation)[1])[0]).reshape(shape).copy()
