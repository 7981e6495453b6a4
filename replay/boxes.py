"""Annotated boxes in files: ``boxes.json``, the answer of ``query MAP instances``, and the XML of KITTI-360.

``boxes.json`` is ``{"boxes": [...], "merge": {...}}``. A box has ``id``, ``class``, ``shape`` (box, ellipsoid, prism or
mesh; box if left out), ``T_world_box`` (4x4), ``size`` (3, metres), ``polygon`` of a prism or ``vertices`` and
``faces`` of a mesh, ``thing`` (by its class if left out), and ``stamps`` (``[[ns, 4x4], ...]``) where it moves.
``merge`` names, for a class of the pseudo labels, the classes that they cannot tell from it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np

from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.fields.primitives import SHAPES, Primitive, ShapeName
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.replay.importers.kitti360 import LABELS as KITTI360_LABELS
from semantic_mapper.types import Float64, Int64

MAX_FILE_BYTES = 1 << 28  # 50,000 boxes of KITTI-360 take 0.1 GB
MAX_ID = 65535  # what an instance image of 16 bits holds; 0 is none
QUERY_MARGIN_M = 0.05  # boxes of `query` end in the middle of surface voxels; this far beyond is theirs, too
KITTI360_THINGS = frozenset(("building", "car", "trailer", "caravan", "box"))  # as its evaluation has them
_KITTI360_NAMES = {"driveway": "parking", "ground": "terrain", "bigpole": "pole"}
_KEYS = {"id", "class", "shape", "T_world_box", "size", "thing", "polygon", "vertices", "faces", "stamps"}


@dataclass(frozen=True, slots=True)
class BoxFile:
    """What a file of boxes says.

    Args:
        primitives: In the order of the file, those that move among them.
        merge: By class of the pseudo labels: classes that they cannot tell from it.
        left_out: How many boxes of the file are of no class at all (KITTI-360's "unknown").
    """

    primitives: tuple[Primitive, ...]
    merge: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    left_out: int = 0


class _BadBoxError(ValueError):
    """What is wrong with one box; ``load_boxes`` adds the file and the number."""


def load_boxes(path: Path) -> BoxFile:
    """Read a file of boxes in any of the three formats.

    Raises:
        ConfigError: no such file, neither format, or a box that cannot be used, with its number in the file.
    """
    text = _read(path)
    if text.lstrip().startswith(b"<"):
        return _from_kitti360(text, path)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is neither JSON nor XML: {error}") from error
    if isinstance(data, dict) and data.get("question") == "instances":
        listed, read = data.get("instances"), _from_query
    elif isinstance(data, dict) and "boxes" in data:
        listed, read = data["boxes"], _from_json
    else:
        raise ConfigError(
            f"{path} holds no boxes; give a boxes.json, the JSON of `query MAP instances`, or XML of KITTI-360"
        )
    if not isinstance(listed, list):
        raise ConfigError(f"{path}: the boxes must be a list, not a {type(listed).__name__}")
    merge = _read_merge(cast("dict[str, Any]", data).get("merge", {}), path)
    primitives = [_checked(read, entry, path, n) for n, entry in enumerate(cast("list[Any]", listed), 1)]
    return BoxFile(_all_different(primitives, path), merge)


def save_boxes(path: Path, boxes: BoxFile) -> None:
    """Write ``boxes.json``, in one step; reading it gives the same boxes again."""
    listed = [json.dumps(_to_json(p)) for p in boxes.primitives]
    merge = json.dumps({name: list(rest) for name, rest in boxes.merge.items()})
    text = '{"boxes": [\n' + ",\n".join(listed) + f'\n], "merge": {merge}}}\n'
    write_bytes(path, text.encode())


def check_classes(boxes: BoxFile, label_set: LabelSet, path: Path) -> None:
    """Refuse boxes whose class the label set lacks.

    Raises:
        ConfigError: with the file, the number of the box, and the nearest name.
    """
    named = [(f"box {n}", p.class_name) for n, p in enumerate(boxes.primitives, 1)]
    named += [("merge", name) for group in boxes.merge.items() for name in (group[0], *group[1])]
    for where, name in named:
        if name not in label_set.names:
            near = get_close_matches(name, label_set.names, n=1, cutoff=0.5)
            hint = f"; did you mean '{near[0]}'?" if near else f"; it has {', '.join(label_set.names)}"
            raise ConfigError(f"{path}, {where}: label set '{label_set.name}' has no class '{name}'{hint}")


def _read(path: Path) -> bytes:
    try:
        return read_regular(path, MAX_FILE_BYTES)
    except OSError as error:
        raise ConfigError(f"cannot read boxes from {path}: {error}") from error


def _checked(read: Any, entry: Any, path: Path, number: int) -> Primitive:
    try:
        primitive: Primitive = read(entry)
        primitive.mesh()  # refuses open ones
        return primitive
    except (_BadBoxError, PoseError, ConfigError) as error:
        raise ConfigError(f"{path}, box {number}: {error}") from error


def _all_different(primitives: Sequence[Primitive], path: Path) -> tuple[Primitive, ...]:
    seen: dict[int, int] = {}
    for number, primitive in enumerate(primitives, 1):
        first = seen.setdefault(primitive.id, number)
        if first != number:
            raise ConfigError(f"{path}, box {number}: id {primitive.id} is that of box {first}; give it another")
    return tuple(primitives)


def _read_merge(value: Any, path: Path) -> dict[str, tuple[str, ...]]:
    fits = isinstance(value, dict) and all(
        isinstance(rest, list) and all(isinstance(name, str) for name in cast("list[Any]", rest))
        for rest in cast("dict[str, Any]", value).values()
    )
    if not fits:
        raise ConfigError(f'{path}: merge must be like {{"car": ["trailer", "caravan"]}}')
    return {name: tuple(rest) for name, rest in cast("dict[str, list[str]]", value).items()}


# ---- boxes.json


def _from_json(entry: Any) -> Primitive:
    if not isinstance(entry, dict):
        raise _BadBoxError(f"must be a table of {', '.join(sorted(_KEYS))}")
    given = cast("dict[str, Any]", entry)
    unknown = sorted(set(given) - _KEYS)
    if unknown:
        near = get_close_matches(unknown[0], _KEYS, n=1, cutoff=0.5)
        raise _BadBoxError(f"unknown key '{unknown[0]}'" + (f"; did you mean '{near[0]}'?" if near else ""))
    shape = given.get("shape", "box")
    if shape not in SHAPES:
        raise _BadBoxError(f"shape must be one of {', '.join(SHAPES)}, got {shape!r}")
    name = _class_name(given)
    thing = given.get("thing", name not in STUFF_NAMES)
    if not isinstance(thing, bool):
        raise _BadBoxError(f"thing must be true or false, got {thing!r}")
    pose = _pose(given.get("T_world_box"))
    stamps = given.get("stamps")
    return _sized(
        id=_id(given),
        class_name=name,
        shape=cast("ShapeName", shape),
        T_world_box=pose,
        size=given.get("size"),
        thing=thing,
        polygon=_numbers(given.get("polygon"), "polygon", (None, 2)) if shape == "prism" else None,
        vertices=_numbers(given.get("vertices"), "vertices", (None, 3)) if shape == "mesh" else None,
        faces=_faces(given.get("faces")) if shape == "mesh" else None,
        stamps=None if stamps is None else _stamps(stamps),
    )


def _sized(*, size: Any, vertices: Float64 | None, polygon: Float64 | None, **rest: Any) -> Primitive:
    """With a size that is given, but for meshes, which have their own."""
    if vertices is not None:
        extent = np.ptp(vertices, axis=0)
    else:
        extent = _numbers(size, "size", (3,))
        if not (extent > 0).all():
            raise _BadBoxError(f"size must be above 0 m on all axes, got {extent.tolist()}")
        if polygon is not None:
            extent = np.array([*np.ptp(polygon, axis=0), extent[2]])
    return Primitive(size=extent, vertices=vertices, polygon=polygon, **rest)


def _stamps(value: Any) -> tuple[tuple[int, Float64], ...]:
    if not isinstance(value, list) or not value or not all(isinstance(s, list) and len(s) == 2 for s in value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        raise _BadBoxError("stamps must be [[nanoseconds, 4x4 pose], ...]")
    listed = cast("list[list[Any]]", value)
    if not all(isinstance(s[0], int) for s in listed):
        raise _BadBoxError("stamps must be whole numbers of nanoseconds")
    return tuple((int(s[0]), _pose(s[1])) for s in listed)


def _id(given: Mapping[str, Any]) -> int:
    value = given.get("id")
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MAX_ID:
        raise _BadBoxError(f"id must be a whole number from 1 to {MAX_ID}, got {value!r}")
    return value


def _class_name(given: Mapping[str, Any]) -> str:
    value = given.get("class")
    if not isinstance(value, str) or not value:
        raise _BadBoxError(f"class must be the name of a class, got {value!r}")
    return value


def _numbers(value: Any, name: str, shape: tuple[int | None, ...]) -> Float64:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise _BadBoxError(f"{name} must be numbers: {error}") from error
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("N" if n is None else str(n) for n in shape)
        raise _BadBoxError(f"{name} must be {wanted} numbers, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise _BadBoxError(f"{name} holds NaN or infinity")
    return array


def _faces(value: Any) -> Int64:
    array = _numbers(value, "faces", (None, 3))
    if (array != np.round(array)).any():
        raise _BadBoxError("faces must be whole numbers: the numbers of three vertices each, from 0")
    return array.astype(np.int64)


def _pose(value: Any) -> Float64:
    pose = _numbers(value, "T_world_box", (4, 4))
    try:
        check_pose(pose, "T_world_box")
    except PoseError as error:
        raise _BadBoxError(str(error)) from error
    return pose


def _to_json(primitive: Primitive) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "id": primitive.id,
        "class": primitive.class_name,
        "shape": primitive.shape,
        "T_world_box": primitive.T_world_box.tolist(),
        "size": primitive.size.tolist(),
        "thing": primitive.thing,
    }
    for key in ("polygon", "vertices", "faces"):
        value: Any = getattr(primitive, key)
        if value is not None:
            entry[key] = value.tolist()
    if primitive.stamps is not None:
        entry["stamps"] = [[stamp, pose.tolist()] for stamp, pose in primitive.stamps]
    return entry


# ---- query MAP instances


def _from_query(entry: Any) -> Primitive:
    box = cast("dict[str, Any]", entry).get("box") if isinstance(entry, dict) else None
    if not isinstance(box, dict):
        raise _BadBoxError("an instance must have an id, a class and a box, as `query MAP instances` writes them")
    given, box = cast("dict[str, Any]", entry), cast("dict[str, Any]", box)
    size = _numbers(box.get("size"), "size", (3,))
    if (size < 0).any():
        raise _BadBoxError(f"size must not be below 0 m, got {size.tolist()}")
    pose = np.eye(4)
    pose[:3, :3] = _numbers(box.get("R_world_box"), "R_world_box", (3, 3))
    pose[:3, 3] = _numbers(box.get("center"), "center", (3,))
    name = _class_name(given)
    thing = name not in STUFF_NAMES
    return Primitive(_id(given), name, "box", _pose(pose), size + 2 * QUERY_MARGIN_M, thing)


# ---- KITTI-360


def _from_kitti360(text: bytes, path: Path) -> BoxFile:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path} is no XML: {error}") from error
    nodes = [node for node in root if node.find("transform") is not None]
    if not nodes:
        raise ConfigError(f"{path} holds no boxes; give XML of KITTI-360's data_3d_bboxes")
    known = [(n, node) for n, node in enumerate(nodes, 1) if not _text(node, "label").lower().startswith("unknown")]
    primitives = [_checked(_from_node, node, path, number) for number, node in known]
    return BoxFile(_all_different(primitives, path), left_out=len(nodes) - len(known))


def _from_node(node: ElementTree.Element) -> Primitive:
    """One object. Its transform may scale, so that its vertices become the world's, round their middle."""
    transform = _matrix(node, "transform")
    if transform.shape != (4, 4):
        raise _BadBoxError(f"transform must be 4 x 4, got shape {transform.shape}")
    local, corners = _matrix(node, "vertices"), _matrix(node, "faces").astype(np.int64)
    if local.shape[1] != 3 or corners.shape[1] not in (3, 4):
        raise _BadBoxError(f"vertices must be N x 3 and faces N x 3 or N x 4, got {local.shape} and {corners.shape}")
    faces = corners if corners.shape[1] == 3 else np.concatenate((corners[:, :3], corners[:, (0, 2, 3)]))
    world = local @ transform[:3, :3].T + transform[:3, 3]
    pose = np.eye(4)
    pose[:3, 3] = (world.min(0) + world.max(0)) / 2
    name = _kitti360_name(_text(node, "label"))
    stamp = _whole(node, "timestamp")
    stamps = None if stamp < 0 else ((stamp, pose),)
    vertices = world - pose[:3, 3]
    return Primitive(
        id=_id({"id": _whole(node, "index") + 1}),
        class_name=name,
        shape="mesh",
        T_world_box=pose,
        size=np.ptp(vertices, axis=0),
        thing=name in KITTI360_THINGS,
        vertices=vertices,
        faces=faces,
        stamps=stamps,
    )


def _kitti360_name(label: str) -> str:
    """Its own labels are written without spaces there, and partly have other names."""
    plain = re.sub(r"\s", "", label).lower()
    names = {name.replace(" ", ""): name for name in KITTI360_LABELS.names}
    return _KITTI360_NAMES.get(plain, names.get(plain, label))


def _text(node: ElementTree.Element, name: str) -> str:
    return (node.findtext(name) or "").strip()


def _whole(node: ElementTree.Element, name: str) -> int:
    try:
        return int(_text(node, name))
    except ValueError:
        raise _BadBoxError(f"<{name}> must be a whole number, got '{_text(node, name)}'") from None


def _matrix(node: ElementTree.Element, name: str) -> Float64:
    found = node.find(name)
    if found is None:
        raise _BadBoxError(f"<{name}> is missing")
    values = _numbers(_text(found, "data").split(), name, (None,))
    rows, columns = _whole(found, "rows"), _whole(found, "cols")
    if rows < 1 or columns < 1 or rows * columns != len(values):
        raise _BadBoxError(f"<{name}> says {rows} x {columns} numbers and holds {len(values)}")
    return values.reshape(rows, columns)
