"""Annotated boxes in files: ``boxes.json``, and the answer of ``query MAP instances``.

``boxes.json`` is ``{"boxes": [...], "merge": {...}}``. A box has ``id``, ``class``, ``shape`` (box, ellipsoid, prism or
mesh; box if left out), ``T_world_box`` (4x4), ``size`` (3, metres), ``polygon`` of a prism or ``vertices`` and
``faces`` of a mesh, ``thing`` (by its class if left out), and where it moves ``stamps`` (``[[ns, 4x4], ...]``).
``merge`` names, for a class of the pseudo labels, the classes that they cannot tell from it.
"""

import codecs
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.fields.scene.primitives import Primitive, ShapeName, centred
from semantic_mapper.files import read_regular
from semantic_mapper.geometry import MAX_TRANSLATION_M, check_pose
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.types import Float64

MAX_FILE_BYTES = 1 << 28
MAX_ID = 65535  # what an instance image of 16 bits holds; 0 is background
MIN_SIZE_M = 0.001
QUERY_MARGIN_M = 0.05  # boxes of `query` end in the middle of surface voxels; for a fit, this far beyond is theirs, too
MAX_NAMED = 10  # boxes that cannot be used, in an error
# A box is one thing unless its class is one of these. As KITTI-360 has it, a building is a thing, too.
BOX_STUFF = STUFF_NAMES - {"building"} | {"rail track", "guard rail", "tunnel", "gate", "polegroup"}
# What labels without these classes take them for: those that KITTI-360's paper (Sec. 4) and training ids merge.
MERGE = {
    "sidewalk": ("parking",),
    "building": ("garage",),
    "fence": ("gate",),
    "pole": ("polegroup", "smallpole"),
    "car": ("caravan", "trailer"),
}
Row = tuple[float, float, float, float]
Pose = tuple[Row, Row, Row, Row]
Place = tuple[float, float, float]
NotNegative = Annotated[float, Meta(ge=0)]
WholeNumber = Annotated[int, Meta(ge=0, le=2**63 - 1)]


@dataclass(frozen=True, slots=True)
class BoxFile:
    """What a file of boxes says."""

    primitives: tuple[Primitive, ...]  # in the order of the file, those that move among them
    # by class of the pseudo labels: classes that they cannot tell from it
    merge: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    boxes: list[Any]
    merge: dict[str, tuple[str, ...]] = msgspec.field(default_factory=dict)


class _Box(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"class_name": "class"}):
    id: Annotated[int, Meta(ge=1, le=MAX_ID)]
    class_name: Annotated[str, Meta(pattern=r"\S")]
    T_world_box: Pose
    shape: ShapeName = "box"
    size: Place | None = None
    thing: bool | None = None
    polygon: list[tuple[float, float]] | None = None
    vertices: list[Place] | None = None
    faces: list[tuple[WholeNumber, WholeNumber, WholeNumber]] | None = None
    stamps: list[tuple[WholeNumber, Pose]] | None = None


class _QueryBox(msgspec.Struct, frozen=True):
    center: Place
    size: tuple[NotNegative, NotNegative, NotNegative]
    R_world_box: tuple[Place, Place, Place]


class _Instance(msgspec.Struct, frozen=True, rename={"class_name": "class"}):
    id: int
    class_name: str
    box: _QueryBox


def load_boxes(path: Path, *, query_margin_m: float = 0.0) -> BoxFile:
    """Read a file of boxes in either format; those of ``query`` grow by a margin on each side.

    Raises ConfigError: no such file, neither format, or boxes that cannot be used, each with its number in the file.
    """
    try:
        text = read_regular(path, MAX_FILE_BYTES).removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise ConfigError(f"cannot read boxes from {path}: {error}") from error
    try:
        data: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error).partition("; use sys.set_int_max_str_digits")[0]  # a way out for programmers
        raise ConfigError(f"{path} is no JSON: {reason:.200}") from error
    table = cast("dict[str, Any]", data) if isinstance(data, dict) else {}
    of_query = table.get("question") == "instances"
    if of_query:
        table = {"boxes": table.get("instances"), "merge": table.get("merge", {})}
    elif not get_close_matches("boxes", table, n=1):
        raise ConfigError(f"{path} holds no boxes: give a boxes.json, or the JSON of `query MAP instances`")
    file = convert_config(table, _File, str(path))
    read = partial(_from_query, margin_m=query_margin_m) if of_query else lambda entry: entry
    return BoxFile(_read_all(file.boxes, read, path), file.merge)


def with_classes(boxes: BoxFile, label_set: LabelSet, path: Path, source: str) -> tuple[BoxFile, LabelSet]:
    """Boxes that a field can be fitted with, and the label set of the field: that of the pseudo labels, and classes of
    boxes that one of its classes stands for, as ``merge`` says, or else ``MERGE``.

    ``path`` is the file, and ``source`` where pseudo labels come from, for errors. Raises ConfigError: the label set
    lacks a class, with the file, the id of the box, and the nearest name; or there is no box.
    """
    names = {*label_set.names, *(name for others in boxes.merge.values() for name in others)}
    lacking = {p.class_name for p in boxes.primitives} - names
    merge = dict(boxes.merge)
    for name, others in MERGE.items():
        if name in label_set.names and (found := tuple(o for o in others if o in lacking)):
            merge[name] = (*merge.get(name, ()), *found)
    boxes = replace(boxes, merge=merge)
    merged = {name for others in merge.values() for name in others}
    boxed = dict.fromkeys(p.class_name for p in boxes.primitives)
    known = label_set.with_names([name for name in boxed if name in merged and name not in label_set.names])
    named = [("merge", name, label_set) for name in boxes.merge]
    named += [("merge", name, known) for others in boxes.merge.values() for name in others]
    named += [(f"box with id {p.id}", p.class_name, known) for p in boxes.primitives]
    for where, name, among in named:
        if name not in among.names:
            near = get_close_matches(name, among.names, n=1, cutoff=0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(among.names)}."
            raise ConfigError(
                f"{path}, {where}: label set '{label_set.name}' has no class '{name}'; {hint} Pseudo labels are "
                f"{source}: correct the classes of the boxes, say in `merge` of the file which class of the labels "
                "stands for it, or give other labels or weights (--pseudo)"
            )
    if not boxes.primitives:
        raise ConfigError(f"{path}: holds no box; draw some, or take `query MAP instances`")
    return boxes, known


def _read_all(entries: list[Any], as_json: Callable[[Any], Any], path: Path) -> tuple[Primitive, ...]:
    """Boxes of the entries of a file; ``as_json`` gives what ``boxes.json`` would say. Raises ConfigError: bad ones."""
    good: list[Primitive] = []
    bad: list[str] = []
    first: dict[int, int] = {}
    for number, given in enumerate(entries, 1):
        entry: Any = None
        try:
            box = _read_box(entry := as_json(given))
            if first.setdefault(box.id, number) != number:
                raise ConfigError(f"id {box.id} is that of box {first[box.id]}; give it another")
            good.append(box)
        except (ConfigError, PoseError) as error:
            known: Any = cast("dict[str, Any]", entry).get("id") if isinstance(entry, dict) else None
            bad.append(f"box {number}{f' (id {known})' if type(known) is int else ''}: {error}")
    if bad:
        others = f"; and {len(bad) - MAX_NAMED} others" if len(bad) > MAX_NAMED else ""
        raise ConfigError(f"{path}, {'; '.join(bad[:MAX_NAMED])}{others}")
    return tuple(good)


def _read_box(entry: Any) -> Primitive:
    """An entry of ``boxes.json``, whose outline or mesh is one, with the origin of its axes in its middle."""
    box = convert_config(entry, _Box, "its values")
    polygon, vertices, faces = None, None, None
    size = None if box.size is None else _metres(box.size, "size")
    if box.shape == "mesh":
        if not box.vertices or not box.faces:
            raise ConfigError("a mesh needs vertices and faces")
        vertices, faces = _metres(box.vertices, "vertices"), np.array(box.faces, np.int64)
        size = np.ptp(vertices, axis=0)
    if size is None:
        raise ConfigError("size, three metres, is missing")
    if box.shape == "prism":
        polygon = _metres(box.polygon or [], "polygon").reshape(-1, 2)
        polygon = polygon[(polygon != np.roll(polygon, 1, axis=0)).any(axis=1)]  # a closed ring repeats its first one
        if len(polygon) < 3:
            raise ConfigError(f"polygon must have at least 3 different corners, got {len(polygon)}")
        size = np.array([*np.ptp(polygon, axis=0), size[2]])
    if not (size >= MIN_SIZE_M).all():
        raise ConfigError(f"size must be at least {MIN_SIZE_M} m along all axes, got {size.tolist()}")
    stamps = _stamps(box.stamps)
    pose = stamps[0][1] if stamps else np.array(box.T_world_box, np.float64)
    check_pose(pose, "T_world_box", "box")
    thing = box.class_name not in BOX_STUFF if box.thing is None else box.thing
    made = centred(Primitive(box.id, box.class_name, box.shape, pose, size, thing, polygon, vertices, faces, stamps))
    made.mesh()
    return made


def _metres(value: Any, name: str) -> Float64:
    array = np.array(value, np.float64)
    if not (np.abs(array) <= MAX_TRANSLATION_M).all():
        raise ConfigError(f"{name} must be metres within {MAX_TRANSLATION_M / 1000:g} km")
    return array


def _stamps(known: list[tuple[int, Pose]] | None) -> tuple[tuple[int, Float64], ...] | None:
    """Poses of one that moves, by ascending time."""
    if known is None:
        return None
    poses = {when: np.array(pose, np.float64) for when, pose in known}
    if not poses or len(poses) < len(known):
        raise ConfigError("stamps must be [[whole number, 4x4 pose], ...], each number once")
    for when, pose in poses.items():
        check_pose(pose, f"stamps, pose at {when}", "box")
    return tuple(sorted(poses.items()))


def _from_query(entry: Any, margin_m: float) -> dict[str, Any]:
    thing = convert_config(entry, _Instance, "an instance, as `query MAP instances` writes it")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(thing.box.R_world_box), thing.box.center
    size = [max(metres + 2 * margin_m, MIN_SIZE_M) for metres in thing.box.size]
    return {"id": thing.id, "class": thing.class_name, "T_world_box": pose.tolist(), "size": size}
