"""Poses, paths and graphs as Foxglove draws them in three dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.foxglove.sdk import messages
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.queries.instances import Instance
from semantic_mapper.replay.exporters.base import quaternion
from semantic_mapper.types import Float64

WORLD = "world"  # that of the map
TEXT_M = 0.12  # height of letters
LINE_M = 0.03
PATH_COLOR = messages.Color(r=1.0, g=0.85, b=0.2, a=1.0)
ROOM_COLOR = messages.Color(r=0.9, g=0.9, b=0.95, a=1.0)
DOOR_COLOR = messages.Color(r=1.0, g=0.5, b=0.1, a=1.0)
BOX_OPACITY = 0.35


def camera_frame(camera_id: str) -> str:
    """Name of a camera's frame (x right, y down, z forward), a child of ``WORLD``."""
    return f"camera/{camera_id}"


def stamp(stamp_ns: int) -> messages.Timestamp:
    """Capture time, on the robot's clock."""
    return messages.Timestamp(stamp_ns // 10**9, stamp_ns % 10**9)


def transform(T_map_camera: Float64, child: str, stamp_ns: int) -> messages.FrameTransform:
    """Where a camera is."""
    pose = _pose(T_map_camera[:3, :3], T_map_camera[:3, 3])
    return messages.FrameTransform(
        timestamp=stamp(stamp_ns), parent_frame_id=WORLD, child_frame_id=child, translation=pose[0], rotation=pose[1]
    )


def draw_path(paths: Mapping[str, Sequence[Float64]], stamp_ns: int) -> messages.SceneUpdate:
    """The way of each camera, of poses (4, 4)."""
    return messages.SceneUpdate(
        entities=[
            _entity(f"path/{name}", stamp_ns, lines=[_line([T[:3, 3] for T in poses], PATH_COLOR, closed=False)])
            for name, poses in paths.items()
        ]
    )


def draw_graph(graph: SceneGraph, label_set: LabelSet, stamp_ns: int) -> messages.SceneUpdate:
    """Boxes of things, outlines of rooms and doors, each with its name, in place of all that was drawn before."""
    entities = [_thing(thing, label_set, stamp_ns) for thing in graph.things]
    for room in graph.rooms:
        outline = _line(room.outline, ROOM_COLOR, closed=True)
        name = _text(f"room {room.id}, {room.area_m2:.1f} m2", room.center, ROOM_COLOR)
        entities.append(_entity(f"room/{room.id}", stamp_ns, lines=[outline], texts=[name]))
    for number, door in enumerate(graph.doors):
        top = _text(f"door {door.rooms[0]}-{door.rooms[1]}, {door.width_m:.2f} m", door.center, DOOR_COLOR)
        post = _line([door.center, door.center + 2.0 * graph.up], DOOR_COLOR, closed=False)
        entities.append(_entity(f"door/{number}", stamp_ns, lines=[post], texts=[top]))
    gone = messages.SceneEntityDeletion(timestamp=stamp(stamp_ns), type=messages.SceneEntityDeletionType.All)
    return messages.SceneUpdate(deletions=[gone], entities=entities)


def _thing(thing: Instance, label_set: LabelSet, stamp_ns: int) -> messages.SceneEntity:
    r, g, b = (value / 255 for value in label_set.colors[label_set.ids.index(thing.class_id)])
    position, rotation = _pose(thing.box.R_world_box, thing.box.center)
    cube = messages.CubePrimitive(
        pose=messages.Pose(position=position, orientation=rotation),
        size=_vector(thing.box.size),
        color=messages.Color(r=r, g=g, b=b, a=BOX_OPACITY),
    )
    top = thing.box.center + thing.box.R_world_box[:, 2] * (thing.box.size[2] / 2 + TEXT_M)
    name = _text(f"{thing.class_name} {thing.id}", top, messages.Color(r=r, g=g, b=b, a=1.0))
    return _entity(f"thing/{thing.id}", stamp_ns, cubes=[cube], texts=[name])


def _entity(name: str, stamp_ns: int, **primitives: list[object]) -> messages.SceneEntity:
    return messages.SceneEntity(timestamp=stamp(stamp_ns), frame_id=WORLD, id=name, **primitives)  # pyright: ignore


def _line(points: Sequence[Float64] | Float64, color: messages.Color, *, closed: bool) -> messages.LinePrimitive:
    kinds = messages.LinePrimitiveLineType
    return messages.LinePrimitive(
        type=kinds.LineLoop if closed else kinds.LineStrip,
        pose=messages.Pose(position=messages.Vector3(), orientation=messages.Quaternion(w=1.0)),
        thickness=LINE_M,
        points=[messages.Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in points],
        color=color,
    )


def _text(text: str, at: Float64, color: messages.Color) -> messages.TextPrimitive:
    where = messages.Pose(position=_vector(at), orientation=messages.Quaternion(w=1.0))
    return messages.TextPrimitive(pose=where, billboard=True, font_size=TEXT_M, color=color, text=text)


def _vector(v: Float64) -> messages.Vector3:
    return messages.Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _pose(R: Float64, at: Float64) -> tuple[messages.Vector3, messages.Quaternion]:
    T = np.eye(4)
    T[:3, :3] = R
    x, y, z, w = map(float, quaternion(T))
    return _vector(at), messages.Quaternion(x=x, y=y, z=z, w=w)
