"""Annotated boxes in files: ``boxes.json``, the answer of ``query MAP instances``, and the XML of KITTI-360.

``boxes.json`` is ``{"boxes": [...], "merge": {...}}``. A box has ``id``, ``class``, ``shape`` (box, ellipsoid, prism or
mesh; box if left out), ``T_world_box`` (4x4), ``size`` (3, metres), ``polygon`` of a prism or ``vertices`` and
``faces`` of a mesh, ``thing`` (by its class if left out), and where it moves ``stamps`` (``[[ns, 4x4], ...]``) or,
where no times are known, ``frames`` (``[[number, 4x4], ...]``). ``merge`` names, for a class of the pseudo labels, the
classes that they cannot tell from it.
"""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast
from xml.etree import ElementTree

import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.fields.scene.primitives import Primitive, ShapeName, centred
from semantic_mapper.files import read_regular
from semantic_mapper.geometry import MAX_TRANSLATION_M, check_pose
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.replay.importers.kitti360 import LABELS as KITTI360_LABELS
from semantic_mapper.replay.importers.kitti360 import SOURCE as KITTI360_SOURCE
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.types import Float64

MAX_FILE_BYTES = 1 << 28  # 50,000 boxes of KITTI-360 take 0.1 GB
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
# The XML of KITTI-360 writes labels without spaces, and some under other names.
_XML_NAMES = {name.replace(" ", ""): name for name in KITTI360_LABELS.names}
_XML_NAMES |= {"driveway": "parking", "ground": "terrain", "bigpole": "pole", "pedestrian": "person"}

_FORMATS = "give a boxes.json, the JSON of `query MAP instances`, or XML of KITTI-360's data_3d_bboxes"

_log = get_logger(__name__)

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
    left_out: int = 0  # how many boxes of the file are of no class that is known
    bad: tuple[str, ...] = ()  # boxes of XML that cannot be used: number in the file, id and what is wrong
    is_xml: bool = False  # whether it is one of KITTI-360


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
    frames: list[tuple[WholeNumber, Pose]] | None = None


class _QueryBox(msgspec.Struct, frozen=True):
    center: Place
    size: tuple[NotNegative, NotNegative, NotNegative]
    R_world_box: tuple[Place, Place, Place]


class _Instance(msgspec.Struct, frozen=True, rename={"class_name": "class"}):
    id: int
    class_name: str
    box: _QueryBox


def load_boxes(path: Path, *, query_margin_m: float = 0.0) -> BoxFile:
    """Read a file of boxes in any of the three formats; those of ``query`` grow by a margin on each side.

    Raises ConfigError: no such file, neither format, or boxes that cannot be used, each with its number in the file. Of
    XML these are left out, and counted in a warning, unless all are.
    """
    try:
        text = read_regular(path, MAX_FILE_BYTES).removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise ConfigError(f"cannot read boxes from {path}: {error}") from error
    found = _read_xml(text, path) if text.lstrip().startswith(b"<") else _read_json(text, path, query_margin_m)
    if not found.bad:
        return found
    named = "; ".join(found.bad[:MAX_NAMED])
    if len(found.bad) > MAX_NAMED:
        named += f"; and {len(found.bad) - MAX_NAMED} others"
    if not found.primitives or not found.is_xml:
        raise ConfigError(f"{path}, {named}")
    _log.warning("boxes_left_out", file=str(path), count=len(found.bad), reason=named)
    return found


def with_classes(boxes: BoxFile, label_set: LabelSet, path: Path, source: str) -> tuple[BoxFile, LabelSet]:
    """Boxes that a field can be fitted with, and the label set of the field: that of the pseudo labels, and classes of
    boxes that one of its classes stands for, as ``merge`` says, or else ``MERGE``.

    Boxes of XML of any other class that it lacks are left out, with a warning. ``path`` is the file, and ``source``
    where pseudo labels come from, for errors. Raises ConfigError: the label set lacks a class, with the file, the id of
    the box, and the nearest name; or no box is left.
    """
    names = {*label_set.names, *(name for others in boxes.merge.values() for name in others)}
    lacking = {p.class_name for p in boxes.primitives} - names
    merge = dict(boxes.merge)
    for name, others in MERGE.items():
        if name in label_set.names and (found := tuple(o for o in others if o in lacking)):
            merge[name] = (*merge.get(name, ()), *found)
    boxes = replace(boxes, merge=merge)
    merged = {name for others in merge.values() for name in others}
    unknown = sorted(lacking - merged)
    if boxes.is_xml and unknown:
        kept = tuple(p for p in boxes.primitives if p.class_name not in unknown)
        count = len(boxes.primitives) - len(kept)
        reason = f"label set '{label_set.name}' has no class {', '.join(unknown)}"
        _log.warning("boxes_left_out", file=str(path), count=count, reason=reason)
        boxes = replace(boxes, primitives=kept, left_out=boxes.left_out + count)
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


def with_times(boxes: BoxFile, path: Path, log: Log) -> tuple[BoxFile, list[int]]:
    """Boxes with poses by frame of a drive of KITTI-360, with the times of these frames in a log of it instead; and the
    ids of boxes of which the log lacks all frames, which are dropped. ``path`` is the file of the boxes, for errors.

    Raises ConfigError: the log is of something else, or has none of the frames at which any box is.
    """
    if all(box.frames is None for box in boxes.primitives):
        return boxes, []
    if not log.info.source.startswith(KITTI360_SOURCE):
        raise ConfigError(
            f"{path}: boxes have poses by frame of a drive of KITTI-360, and {log.path} is of '{log.info.source}'; "
            "give the log that `import` made of the drive, or delete these boxes"
        )
    times: dict[int, int] = {}
    for envelope, _ in log.frame_parts():
        times.setdefault(envelope.seq, envelope.stamp_ns)
    kept: list[Primitive] = []
    dropped: list[int] = []
    for box in boxes.primitives:
        stamps = tuple(sorted({times[n]: pose for n, pose in box.frames or () if n in times}.items()))
        if box.frames is None:
            kept.append(box)
        elif stamps:
            kept.append(replace(box, frames=None, stamps=stamps, T_world_box=stamps[0][1]))
        else:
            dropped.append(box.id)
    if not kept:
        raise ConfigError(
            f"{path}: all boxes move, and {log.path} has none of the frames of the drive at which they are"
        )
    return replace(boxes, primitives=tuple(kept)), dropped


def _parse_all(
    entries: Iterable[tuple[int, Any]], as_json: Callable[[Any], Any]
) -> tuple[tuple[Primitive, ...], tuple[str, ...]]:
    """Boxes by their number in the file, and for those that cannot be used a sentence that says why; ``as_json`` gives
    an entry of ``boxes.json``."""
    good: list[Primitive] = []
    bad: list[str] = []
    first: dict[int, int] = {}
    for number, given in entries:
        entry: Any = None
        try:
            box = _read_box(entry := as_json(given))
            if box.frames is None and first.setdefault(box.id, number) != number:
                raise ConfigError(f"id {box.id} is that of box {first[box.id]}; give it another")
            good.append(box)
        except (ConfigError, PoseError) as error:
            known: Any = cast("dict[str, Any]", entry).get("id") if isinstance(entry, dict) else None
            bad.append(f"box {number}{f' (id {known})' if type(known) is int else ''}: {error}")
    return tuple(good), tuple(bad)


def _read_box(entry: Any) -> Primitive:
    """An entry of ``boxes.json``, whose outline or mesh is one, with the origin of its axes in its middle."""
    box = convert_config(entry, _Box, "its values")
    if box.stamps and box.frames:
        raise ConfigError("has stamps and frames; give one of them")
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
    stamps, frames = _poses(box.stamps, "stamps"), _poses(box.frames, "frames")
    pose = (stamps or frames or ((0, np.array(box.T_world_box, np.float64)),))[0][1]
    check_pose(pose, "T_world_box", "box")
    thing = box.class_name not in BOX_STUFF if box.thing is None else box.thing
    made = centred(
        Primitive(box.id, box.class_name, box.shape, pose, size, thing, polygon, vertices, faces, stamps, frames)
    )
    made.mesh()
    return made


def _metres(value: Any, name: str) -> Float64:
    array = np.array(value, np.float64)
    if not (np.abs(array) <= MAX_TRANSLATION_M).all():
        raise ConfigError(f"{name} must be metres within {MAX_TRANSLATION_M / 1000:g} km")
    return array


def _poses(known: list[tuple[int, Pose]] | None, name: str) -> tuple[tuple[int, Float64], ...] | None:
    """Poses of one that moves, by ascending time or number of the frame."""
    if known is None:
        return None
    poses = {when: np.array(pose, np.float64) for when, pose in known}
    if not poses or len(poses) < len(known):
        raise ConfigError(f"{name} must be [[whole number, 4x4 pose], ...], each number once")
    for when, pose in poses.items():
        check_pose(pose, f"{name}, pose at {when}", "box")
    return tuple(sorted(poses.items()))


def _read_json(text: bytes, path: Path, query_margin_m: float) -> BoxFile:
    try:
        data: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error).partition("; use sys.set_int_max_str_digits")[0]  # a way out for programmers
        raise ConfigError(f"{path} is neither JSON nor XML: {reason:.200}") from error
    table = cast("dict[str, Any]", data) if isinstance(data, dict) else {}
    of_query = table.get("question") == "instances"
    if of_query:
        table = {"boxes": table.get("instances"), "merge": table.get("merge", {})}
    elif not get_close_matches("boxes", table, n=1):
        raise ConfigError(f"{path} holds no boxes: {_FORMATS}")
    file = convert_config(table, _File, str(path))
    read = partial(_from_query, margin_m=query_margin_m) if of_query else lambda entry: entry
    good, bad = _parse_all(enumerate(file.boxes, 1), read)
    return BoxFile(good, file.merge, bad=bad)


def _from_query(entry: Any, margin_m: float) -> dict[str, Any]:
    """One instance of `query MAP instances`."""
    thing = convert_config(entry, _Instance, "an instance, as `query MAP instances` writes it")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(thing.box.R_world_box), thing.box.center
    size = [max(metres + 2 * margin_m, MIN_SIZE_M) for metres in thing.box.size]
    return {"id": thing.id, "class": thing.class_name, "T_world_box": pose.tolist(), "size": size}


def _read_xml(text: bytes, path: Path) -> BoxFile:
    """Objects of ``data_3d_bboxes``, as the devkit of KITTI-360 (``helpers/annotation.py``) reads them, in their order.

    Each has ``label``, ``index``, ``transform`` (4x4, may scale), ``vertices``, ``faces``, ``instanceId`` and
    ``timestamp``. One that moves is there many times, each with the number of a frame of the drive as its timestamp,
    and becomes one box with its poses by frame; -1 says that it stands still."""
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # or of another character set
        raise ConfigError(f"{path} is no XML in UTF-8: {error}") from error
    nodes = [node for node in root if node.find("transform") is not None]
    if not nodes:
        raise ConfigError(f"{path} holds no boxes: {_FORMATS}")
    objects: dict[Any, tuple[int, list[ElementTree.Element]]] = {}  # each with the number of its first node
    left_out = 0
    for number, node in enumerate(nodes, 1):
        label, instance = _text(node, "label"), _text(node, "instanceId")
        if label.lower().startswith("unknown"):
            left_out += 1
        elif not _moves(node):
            objects[number] = number, [node]
        else:
            what = label, instance if instance.strip("0") else f"index {_text(node, 'index')}"
            objects.setdefault(what, (number, []))[1].append(node)
    good, bad = _parse_all(objects.values(), _from_nodes)
    return BoxFile(good, left_out=left_out, bad=bad, is_xml=True)


def _from_nodes(nodes: list[ElementTree.Element]) -> dict[str, Any]:
    """One object in axes of its own, in the shape that it had at first."""
    vertices, faces = (_matrix(nodes[0], name) for name in ("vertices", "faces"))
    if vertices.shape[1] != 3 or faces.shape[1] not in (3, 4):
        raise ConfigError(f"vertices must be N x 3, faces N x 3 or N x 4, got {vertices.shape} and {faces.shape}")
    if (faces == np.round(faces)).all() and (np.abs(faces) < 1e9).all():
        faces = faces.astype(np.int64)
    transform, pose = np.eye(4), np.eye(4)
    frames: dict[int, list[list[float]]] = {}
    for node in reversed(nodes):
        transform = _matrix(node, "transform")
        if transform.shape != (4, 4):
            raise ConfigError(f"transform must be 4 x 4, got {transform.shape}")
        u, _, v = np.linalg.svd(transform[:3, :3])  # the nearest rotation to a matrix that may scale
        pose = transform.copy()
        pose[3] = 0, 0, 0, 1
        pose[:3, :3] = u @ np.diag((1, 1, -1 if np.linalg.det(u @ v) < 0 else 1)) @ v
        frames[_whole(node, "timestamp") if _moves(node) else -1] = pose.tolist()
    label = _text(nodes[0], "label")
    return {
        "id": _whole(nodes[0], "index") + 1,
        "class": _XML_NAMES.get(re.sub(r"\s", "", label).lower(), label),
        "shape": "mesh",
        "T_world_box": pose.tolist(),
        "vertices": (vertices @ (pose[:3, :3].T @ transform[:3, :3]).T).tolist(),
        "faces": [*faces[:, :3].tolist(), *(faces[:, (0, 2, 3)].tolist() if faces.shape[1] == 4 else ())],
        "frames": sorted(frames.items()) if _moves(nodes[0]) else None,
    }


def _moves(node: ElementTree.Element) -> bool:
    return _text(node, "timestamp") not in ("", "-1")


def _text(node: ElementTree.Element, name: str) -> str:
    return (node.findtext(name) or "").strip()


def _whole(node: ElementTree.Element, name: str) -> int:
    text = _text(node, name)
    if not re.fullmatch(r"-?\d{1,18}", text):
        raise ConfigError(f"<{name}> must be a whole number, got '{text:.40}'")
    return int(text)


def _matrix(node: ElementTree.Element, name: str) -> Float64:
    found = node.find(name)
    if found is None:
        raise ConfigError(f"<{name}> is missing")
    try:
        values = np.array(_text(found, "data").split(), np.float64)
    except ValueError as error:
        raise ConfigError(f"{name} must be numbers: {error}") from error
    rows, columns = _whole(found, "rows"), _whole(found, "cols")
    if rows < 1 or columns < 1 or rows * columns != len(values) or not np.isfinite(values).all():
        raise ConfigError(f"<{name}> says {rows} x {columns} numbers and holds {len(values)}, or NaN or infinity")
    return values.reshape(rows, columns)
