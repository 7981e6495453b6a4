"""Answers about a map, as plain data."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import scale_name
from semantic_mapper.queries.find import FoundObject
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
from semantic_mapper.queries.objects import ObjectChange, ObjectPlace
from semantic_mapper.queries.occupancy import State
from semantic_mapper.queries.phrase import OTHER_WEIGHT
from semantic_mapper.queries.questions import RememberedObjects
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import surface_voxels
from semantic_mapper.types import Float64

DIGITS = 4  # 0.1 mm


def describe_map(snapshot: MapSnapshot) -> dict[str, Any]:
    """Size and classes of a map."""
    surface = surface_voxels(snapshot)
    label = snapshot.voxels.label[snapshot.slots[surface.row], surface.voxel]
    measured = snapshot.measured(snapshot.slots[surface.row].astype(np.int64), surface.voxel.astype(np.int64))
    labels = snapshot.label_set
    counts = {name: int((label == i).sum()) for i, name in zip(labels.ids, labels.names, strict=True)}
    xyz = surface.point * snapshot.voxel_size_m
    return {
        "question": "info",
        "frames": snapshot.version,
        "scale": scale_name(snapshot.scale_known),
        "voxel_size_m" if snapshot.scale_known else "voxel_size": snapshot.voxel_size_m,
        "blocks": snapshot.block_count,
        "surface_voxels": len(label),
        "computed": round(float(1 - measured.mean()), DIGITS) if len(label) else None,
        "without_class": int((label == labels.ignore_id).sum()),
        "lower": _rounded(xyz.min(axis=0)) if len(xyz) else None,
        "upper": _rounded(xyz.max(axis=0)) if len(xyz) else None,
        "label_set": labels.name,
        "classes": counts,
    }


def answer_at(
    labels: LabelSet, point: Sequence[float], answers: PointAnswers, things: Sequence[Instance]
) -> dict[str, Any]:
    """What is at a point: the answers of ``nearest.at`` to it alone, and in the boxes of which things it lies."""
    label = int(answers.label[0])
    known = np.isfinite(answers.distance_m[0])
    return {
        "question": "at",
        "point": list(point),
        "class": labels.names[labels.ids.index(label)] if label != labels.ignore_id else None,
        "confidence": round(float(answers.confidence[0]), DIGITS),
        "surface_distance_m": round(float(answers.distance_m[0]), DIGITS) if known else None,
        "state": State(int(answers.state[0])).name.lower(),
        "measured": bool(answers.measured[0]) if known and answers.measured is not None else None,
        "inside": [{"id": thing.id, "class": thing.class_name} for thing in things if thing.box.holds(point)],
    }


def answer_nearest(class_name: str, point: Sequence[float], hit: NearestSurface | None) -> dict[str, Any]:
    """Where the nearest surface of a class is, and the thing there, as ``nearest.nearest`` says."""
    found: dict[str, Any] = {"question": "nearest", "class": class_name, "point": list(point), "found": hit is not None}
    if hit is not None:
        found |= {"xyz": _rounded(hit.xyz), "distance_m": round(hit.distance_m, DIGITS)}
        found |= {"confidence": round(hit.confidence, DIGITS), "measured": hit.measured}
        found["thing"] = None if hit.thing is None else _describe_thing(hit.thing)
    return found


NO_FLOOR = "no floor was found: too little level surface, or another direction is up (--up)"


def answer_instances(up: Sequence[float], instances: Sequence[Instance]) -> dict[str, Any]:
    """The things in a map, the most certain first.

    Those that have gone are ``gone``, the latest first; the key is left out while nothing has gone.
    """
    there = sorted((t for t in instances if t.gone_ns is None), key=lambda thing: -thing.certainty)
    gone = sorted((t for t in instances if t.gone_ns is not None), key=lambda thing: thing.gone_ns or 0, reverse=True)
    found: dict[str, Any] = {"question": "instances", "up": list(up)}
    found["instances"] = [_describe_thing(thing) for thing in there]
    found |= {"gone": [{**_describe_thing(t), "gone_ns": t.gone_ns} for t in gone]} if gone else {}
    return found


def answer_changes(since_ns: int | None, changes: Sequence[ObjectChange]) -> dict[str, Any]:
    """What was moved, is new, or has gone after a stamp, the surest first. Raises MapError: there is no stamp, since
    there is no map of before."""
    if since_ns is None:
        raise MapError(
            "changes: there is no map of before; `up --set mapper.map=FILE` goes on in one, --since names one"
        )
    return {
        "question": "changes",
        "since_ns": since_ns,
        "changes": [
            {
                "kind": change.kind,
                "id": change.object.id,
                "class": change.object.class_name,
                "probability": round(change.probability, DIGITS),
                "before": None if change.before is None else _describe_place(change.before),
                "now": None if change.kind == "gone" else _describe_place(change.object.places[-1]),
                "views": change.object.views,
                "missed": change.object.missed,
            }
            for change in changes
        ],
    }


def answer_find(phrase: str, answers: Sequence[FoundObject]) -> dict[str, Any]:
    """The objects that a phrase means, the likeliest first; and a note where no class is meant alone."""
    found = [
        {
            "id": answer.object.id,
            "class": answer.object.class_name,
            "probability": round(answer.probability, DIGITS),
            "parts": {name: round(value, DIGITS) for name, value in answer.parts.items()},
            "room": answer.object.room,
            "room_kind": answer.room_kind,
            "box": _describe_box(answer.object.box),
            "last_seen_ns": answer.object.last_seen_ns,
            "gone_ns": answer.object.gone_ns,
            "T_world_camera": None if answer.T_world_camera is None else np.round(answer.T_world_camera, 6).tolist(),
            "picture": None,
        }
        for answer in answers
    ]
    vague = answers and all(answer.parts["class"] <= OTHER_WEIGHT for answer in answers)
    note = {"note": "no class of the map is this thing alone: these are of a class of many kinds"} if vague else {}
    return {"question": "find", "phrase": phrase, **note, "answers": found}


def describe_memory(memory: RememberedObjects) -> list[dict[str, Any]]:
    """All objects that a map remembers, by id, with what has become of each."""
    kinds = {change.object.id: change.kind for change in memory.changes}
    return [
        {
            "id": o.id,
            "class": o.class_name,
            "probability": round(o.probability, DIGITS),
            "first_seen_ns": o.first_seen_ns,
            "last_seen_ns": o.last_seen_ns,
            "gone_ns": o.gone_ns,
            "change": kinds.get(o.id),
            "places": [_describe_place(place) for place in o.places],
        }
        for o in memory.objects
    ]


def _describe_place(place: ObjectPlace) -> dict[str, Any]:
    return {"since_ns": place.stamp_ns, "room": place.room, "box": _describe_box(place.box)}


def answer_graph(graph: SceneGraph) -> dict[str, Any]:
    """Floors, rooms, doors and objects; places are world metres, and ids are those of the tracker."""
    return {
        "question": "graph",
        "up": _rounded(graph.up),
        "floors": [{"id": f.id, "height_m": round(f.height_m, DIGITS), "rooms": list(f.rooms)} for f in graph.floors],
        "rooms": [
            {
                "id": room.id,
                "floor": room.floor,
                "area_m2": round(room.area_m2, DIGITS),
                "center": _rounded(room.center),
                "outline": _rounded(room.outline),
                "neighbours": sorted(
                    {n for door in graph.doors if room.id in door.rooms for n in door.rooms} - {room.id}
                ),
                "objects": [thing.id for thing in graph.things if graph.room_of[thing.id] == room.id],
            }
            for room in graph.rooms
        ],
        "doors": [
            {"rooms": list(door.rooms), "center": _rounded(door.center), "width_m": round(door.width_m, DIGITS)}
            for door in graph.doors
        ],
        "objects": [{**_describe_thing(thing), "room": graph.room_of[thing.id]} for thing in graph.things],
    }


def _describe_thing(thing: Instance) -> dict[str, Any]:
    return {
        "id": thing.id,
        "class": thing.class_name,
        "certainty": round(thing.certainty, DIGITS),
        "seen": round(thing.seen, DIGITS),
        "confidence": round(thing.confidence, DIGITS),
        "voxels": len(thing.voxels),
        "measured": round(thing.measured, DIGITS),
        "centroid": _rounded(thing.centroid),
        "box": _describe_box(thing.box),
    }


def _describe_box(box: OrientedBox) -> dict[str, Any]:
    R = np.round(box.R_world_box, 6).tolist()
    return {"center": _rounded(box.center), "size": _rounded(box.size), "R_world_box": R}


def _rounded(xyz: Float64) -> list[float]:
    return np.round(xyz, DIGITS).tolist()
