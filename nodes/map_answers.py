"""Answers about a map, as plain data and as tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import length_unit, scale_name
from semantic_mapper.plain_text import counted
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
from semantic_mapper.queries.occupancy import State
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import surface_voxels
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.types import Float64

DIGITS = 4  # 0.1 mm
MIN_CLASS_WIDTH = 8  # of their column, on a narrow terminal


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


def answer_at(labels: LabelSet, point: Sequence[float], answers: PointAnswers) -> dict[str, Any]:
    """What is at a point: the answers of ``nearest.at`` to it alone."""
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
    }


def answer_nearest(class_name: str, point: Sequence[float], hit: NearestSurface | None) -> dict[str, Any]:
    """Where the nearest surface of a class is, as ``nearest.nearest`` says."""
    found: dict[str, Any] = {"question": "nearest", "class": class_name, "point": list(point), "found": hit is not None}
    if hit is not None:
        found |= {"xyz": _rounded(hit.xyz), "distance_m": round(hit.distance_m, DIGITS)}
        found |= {"confidence": round(hit.confidence, DIGITS), "measured": hit.measured}
    return found


UP = (0.0, 0.0, 1.0)  # of the boxes of instances, where nothing else is given
NO_FLOOR = "no floor was found: too little level surface, or another way is up (--up)"
CONNECTED = "connected pieces of one class"


def answer_instances(up: Sequence[float], instances: Sequence[Instance], separated_by: str = "") -> dict[str, Any]:
    """The things in a map, the surest first, and by which means they were separated; empty = not known.

    Those that have gone are ``gone``, the latest first; the key is left out while nothing has gone.
    """
    there = sorted((t for t in instances if t.gone_ns is None), key=lambda thing: -thing.rank)
    gone = sorted((t for t in instances if t.gone_ns is not None), key=lambda thing: thing.gone_ns or 0, reverse=True)
    found: dict[str, Any] = {"question": "instances", "up": list(up)}
    found |= {"separated_by": separated_by} if separated_by else {}
    found["instances"] = [_describe_thing(thing) for thing in there]
    found |= {"gone": [{**_describe_thing(t), "gone_ns": t.gone_ns} for t in gone]} if gone else {}
    return found


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
        "confidence": round(thing.confidence, DIGITS),
        "voxels": len(thing.voxels),
        "measured": round(thing.measured, DIGITS),
        "centroid": _rounded(thing.centroid),
        "box": {
            "center": _rounded(thing.box.center),
            "size": _rounded(thing.box.size),
            "R_world_box": np.round(thing.box.R_world_box, 6).tolist(),
        },
    }


def answer_table(found: dict[str, Any], width: int) -> Table:
    """An answer, for people, on a terminal of ``width`` characters."""
    if found["question"] == "instances":
        return _instance_table(found, width)
    if found["question"] == "graph":
        return _graph_table(found)
    unit = length_unit(found.get("scale") != SCALE_UNKNOWN)
    table = Table(title=found["map"], title_justify="left", show_header=False)
    for key, value in found.items():
        if key not in ("map", "question", "classes"):
            unnamed = key == "class" and value is None and found["surface_distance_m"] is not None
            table.add_row(key.replace("_", " "), "unknown" if unnamed else _text(value, unit))
    if "classes" in found:
        table.add_section()
        for name, count in sorted(found["classes"].items(), key=lambda item: -item[1]):
            if count:
                table.add_row(name, counted(count, "surface voxel"))
    return table


def _instance_table(found: dict[str, Any], width: int) -> Table:
    by = found.get("separated_by")
    table = Table(title=f"{found['map']}, things by {by}" if by else found["map"], title_justify="left")
    rows = [
        (
            str(thing["id"]),
            thing["class"],
            f"{thing['confidence']:.2f}",
            str(thing["voxels"]),
            f"{thing['measured'] * 100:.0f} %",
            _joined(thing["centroid"]),
            _joined(thing["box"]["size"]),
            f"{thing['gone_ns'] / 1e9:.2f}" if "gone_ns" in thing else "",
        )
        for thing in (*found["instances"], *found.get("gone", ()))
    ]
    names = ("id", "class", "confidence", "voxels", "measured", "centroid, m", "box, m", "gone at, s")
    if not found.get("gone"):
        names, rows = names[:-1], [row[:-1] for row in rows]
    widths = [max(map(len, column)) for column in zip(names, *rows, strict=True)]
    for name, widest in zip(names, widths, strict=True):
        if name == "class":
            table.add_column(name, overflow="fold")
        else:
            table.add_column(name, no_wrap=True, min_width=widest)
    widths[names.index("class")] = MIN_CLASS_WIDTH
    # Numbers are never cut: one that lacks digits is another one. A terminal that is too narrow breaks the lines.
    narrowest = sum(widths) + 3 * len(widths) + 1
    if width < narrowest:
        table.width = narrowest
    for row in rows:
        table.add_row(*row)
    return table


def _graph_table(found: dict[str, Any]) -> Table:
    table = Table(title=found["map"], title_justify="left")
    if not found["floors"]:
        table.caption = NO_FLOOR
    for name in ("room", "floor", "area, m2", "doors to", "objects"):
        table.add_column(name, overflow="fold", min_width=len(name))
    class_of = {thing["id"]: thing["class"] for thing in found["objects"]}
    for room in found["rooms"]:
        counts = Counter(class_of[number] for number in room["objects"])
        objects = ", ".join(name if count == 1 else f"{count} {name}" for name, count in sorted(counts.items()))
        doors = " ".join(map(str, room["neighbours"]))
        table.add_row(str(room["id"]), str(room["floor"]), f"{room['area_m2']:.1f}", doors, objects)
    return table


def _text(value: Any, unit: str) -> str:
    if isinstance(value, list):
        return f"{_joined(value)} {unit}"
    return "none" if value is None else str(value)


def _joined(xyz: list[float]) -> str:
    return " ".join(f"{x:.2f}" for x in xyz)


def _rounded(xyz: Float64) -> list[float]:
    return np.round(xyz, DIGITS).tolist()
