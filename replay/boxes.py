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
from collections.abc import Callable, Collection
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import numpy as np

from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.fields.primitives import SHAPES, Primitive
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.replay.box_values import (
    BadBox,
    BoxFile,
    box_of,
    class_of,
    each_once,
    is_thing,
    metres,
    numbers,
    outline,
    pose_of,
    poses_by,
    whole_faces,
    whole_id,
)
from semantic_mapper.replay.kitti360_boxes import MERGE, read_kitti360
from semantic_mapper.types import Float64

MAX_FILE_BYTES = 1 << 28  # 50,000 boxes of KITTI-360 take 0.1 GB
QUERY_MARGIN_M = 0.05  # boxes of `query` end in the middle of surface voxels; this far beyond is theirs, too
MAX_NAMED = 10  # boxes that cannot be used, in an error
_TIMES = {"stamps": "nanoseconds", "frames": "frames"}
_FILE_KEYS = {"boxes", "merge"}
_KEYS = {"id", "class", "shape", "T_world_box", "size", "thing", "polygon", "vertices", "faces", "stamps", "frames"}

_log = get_logger(__name__)


def load_boxes(path: Path) -> BoxFile:
    """Read a file of boxes in any of the three formats.

    Raises:
        ConfigError: no such file, neither format, or boxes that cannot be used, each with its number in the file. Of
            XML these are left out, and counted in a warning.
    """
    return usable(path, read_boxes(path))


def read_boxes(path: Path) -> BoxFile:
    """As ``load_boxes``; boxes that cannot be used are in ``BoxFile.bad``.

    Raises:
        ConfigError: no such file, or neither format.
    """
    text = _read(path)
    if text.lstrip().startswith(b"<"):
        return read_kitti360(text, path)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = str(error).partition("; use sys.set_int_max_str_digits")[0]  # a way out for programmers
        raise ConfigError(f"{path} is neither JSON nor XML: {reason}") from error
    listed, read, merge = _listed(data, path)
    good: list[tuple[int, Primitive]] = []
    bad: list[BadBox] = []
    for number, entry in enumerate(listed, 1):
        try:
            good.append((number, read(entry)))
        except (ConfigError, PoseError) as error:
            box_id: Any = cast("dict[str, Any]", entry).get("id") if isinstance(entry, dict) else None
            known = isinstance(box_id, int) and not isinstance(box_id, bool)
            bad.append(BadBox(number, box_id if known else None, str(error)))
    primitives, every_bad = each_once(good, bad)
    return BoxFile(primitives, _read_merge(merge, path), bad=every_bad)


def usable(path: Path, found: BoxFile) -> BoxFile:
    """The file, if its boxes can be used.

    Raises:
        ConfigError: some cannot, or, of XML, none.
    """
    if not found.bad:
        return found
    named = "; ".join(map(str, found.bad[:MAX_NAMED]))
    if len(found.bad) > MAX_NAMED:
        named += f"; and {len(found.bad) - MAX_NAMED} others"
    if found.is_xml and found.primitives:
        _log.warning("boxes_left_out", file=str(path), count=len(found.bad), reason=named)
        return found
    raise ConfigError(f"{path}, {named}")


def save_boxes(path: Path, boxes: BoxFile) -> None:
    """Write ``boxes.json``, in one step; reading it gives the same boxes again."""
    listed = [json.dumps(_to_json(p)) for p in boxes.primitives]
    merge = json.dumps({name: list(rest) for name, rest in boxes.merge.items()})
    text = '{"boxes": [\n' + ",\n".join(listed) + f'\n], "merge": {merge}}}\n'
    write_bytes(path, text.encode())


def check_box(box: Primitive) -> None:
    """Refuse a box that could not be read again.

    Raises:
        ConfigError, PoseError: with what is wrong.
    """
    _from_json(_to_json(box))


def with_classes(boxes: BoxFile, label_set: LabelSet, path: Path) -> tuple[BoxFile, LabelSet]:
    """Boxes that a field can be fitted with, and the label set of the field.

    That is the one of the pseudo labels, and those classes of boxes that it lacks, but that a class of it may stand for
    as ``merge`` says, or else ``kitti360_boxes.MERGE``. Boxes of XML of KITTI-360 of any other class that it lacks are
    left out, with a warning.

    Args:
        boxes: Of a file.
        label_set: Of the pseudo labels.
        path: Of the file, for errors.

    Raises:
        ConfigError: the label set lacks a class, with the file, the id of the box, and the nearest name; or, of XML,
            the classes of most boxes.
    """
    boxes = _merged(boxes, label_set)
    merged = {name for others in boxes.merge.values() for name in others}
    if boxes.is_xml:
        boxes = _of_known_classes(boxes, merged.union(label_set.names), label_set, path)
    boxed = dict.fromkeys(p.class_name for p in boxes.primitives)
    known = label_set.with_names([name for name in boxed if name in merged and name not in label_set.names])
    named = [("merge", name, label_set) for name in boxes.merge]
    named += [("merge", name, known) for others in boxes.merge.values() for name in others]
    named += [(f"box with id {p.id}", p.class_name, known) for p in boxes.primitives]
    for where, name, among in named:
        if name not in among.names:
            near = get_close_matches(name, among.names, n=1, cutoff=0.5)
            hint = f"; did you mean '{near[0]}'?" if near else f"; it has {', '.join(among.names)}"
            raise ConfigError(f"{path}, {where}: label set '{label_set.name}' has no class '{name}'{hint}")
    return boxes, known


def _merged(boxes: BoxFile, label_set: LabelSet) -> BoxFile:
    """Boxes whose ``merge`` also has what ``MERGE`` says of their classes that neither it nor the label set has."""
    named = {*label_set.names, *(name for others in boxes.merge.values() for name in others)}
    lacking = {p.class_name for p in boxes.primitives} - named
    merge = dict(boxes.merge)
    for name, others in MERGE.items():
        if name in label_set.names and (found := tuple(o for o in others if o in lacking)):
            merge[name] = (*merge.get(name, ()), *found)
    return replace(boxes, merge=merge)


def _of_known_classes(boxes: BoxFile, known: Collection[str], label_set: LabelSet, path: Path) -> BoxFile:
    """Boxes of XML of classes that are known; the others are counted.

    Raises:
        ConfigError: these are more.
    """
    kept = tuple(p for p in boxes.primitives if p.class_name in known)
    count = len(boxes.primitives) - len(kept)
    if not count:
        return boxes
    lacking = sorted({p.class_name for p in boxes.primitives} - set(known))
    reason = f"label set '{label_set.name}' has no class {', '.join(lacking)}"
    if count > len(kept):
        raise ConfigError(
            f"{path}: {reason}, of which {count} of {len(boxes.primitives)} boxes are; it has "
            f"{', '.join(label_set.names)}"
        )
    _log.warning("boxes_left_out", file=str(path), count=count, reason=reason)
    return replace(boxes, primitives=kept, left_out=boxes.left_out + count)


def _read(path: Path) -> bytes:
    try:
        return read_regular(path, MAX_FILE_BYTES).removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise ConfigError(f"cannot read boxes from {path}: {error}") from error


def _listed(data: Any, path: Path) -> tuple[list[Any], Callable[[Any], Primitive], Any]:
    """Entries of a file, what reads one, and what it says about merging."""
    table = cast("dict[str, Any]", data) if isinstance(data, dict) else {}
    if table.get("question") == "instances":
        listed, read = table.get("instances"), _from_query
    else:
        if "boxes" not in table and not get_close_matches("boxes", table, n=1):
            raise ConfigError(
                f"{path} holds no boxes; give a boxes.json, the JSON of `query MAP instances`, or XML of KITTI-360"
            )
        _refuse_unknown(table, _FILE_KEYS, f"{path}: ")
        listed, read = table["boxes"], _from_json
    if not isinstance(listed, list):
        raise ConfigError(f"{path}: the boxes must be a list, not a {type(listed).__name__}")
    return cast("list[Any]", listed), read, table.get("merge", {})


def _refuse_unknown(given: dict[str, Any], keys: Collection[str], where: str = "") -> None:
    unknown = sorted(set(given) - set(keys))
    if unknown:
        near = get_close_matches(unknown[0], keys, n=1, cutoff=0.5)
        hint = f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(sorted(keys))}"
        raise ConfigError(f"{where}unknown key '{unknown[0]:.40}'{hint}")


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
        raise ConfigError(f"must be a table of {', '.join(sorted(_KEYS))}")
    given = cast("dict[str, Any]", entry)
    _refuse_unknown(given, _KEYS)
    shape = given.get("shape", "box")
    if shape not in SHAPES:
        raise ConfigError(f"shape must be one of {', '.join(SHAPES)}, got {shape!r:.40}")
    name = class_of(given.get("class"))
    thing = given.get("thing", is_thing(name))
    if not isinstance(thing, bool):
        raise ConfigError(f"thing must be true or false, got {thing!r:.40}")
    polygon = outline(given.get("polygon")) if shape == "prism" else None
    vertices = metres(given.get("vertices"), "vertices", (None, 3)) if shape == "mesh" else None
    stamps, frames = (poses_by(given[k], k, unit) if given.get(k) is not None else None for k, unit in _TIMES.items())
    if stamps and frames:
        raise ConfigError("has stamps and frames; give one of them")
    pose = pose_of(given.get("T_world_box"))
    return box_of(
        _extent(given.get("size"), polygon, vertices),
        id=whole_id(given.get("id")),
        class_name=name,
        shape=shape,
        T_world_box=(stamps or frames or ((0, pose),))[0][1],
        thing=thing,
        polygon=polygon,
        vertices=vertices,
        faces=whole_faces(given.get("faces")) if shape == "mesh" else None,
        stamps=stamps,
        frames=frames,
    )


def _extent(size: Any, polygon: Float64 | None, vertices: Float64 | None) -> Float64:
    """Size (3,) that is given; outlines and meshes have their own."""
    if vertices is not None:
        if not len(vertices):
            raise ConfigError("vertices must be N x 3 numbers, got none")
        return np.ptp(vertices, axis=0)
    extent = metres(size, "size", (3,))
    return extent if polygon is None else np.array([*np.ptp(polygon, axis=0), extent[2]])


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
    for key, known in (("stamps", primitive.stamps), ("frames", primitive.frames)):
        if known is not None:
            entry[key] = [[when, pose.tolist()] for when, pose in known]
    return entry


# ---- query MAP instances


def _from_query(entry: Any) -> Primitive:
    box = cast("dict[str, Any]", entry).get("box") if isinstance(entry, dict) else None
    if not isinstance(box, dict):
        raise ConfigError("an instance must have an id, a class and a box, as `query MAP instances` writes them")
    given, box = cast("dict[str, Any]", entry), cast("dict[str, Any]", box)
    size = metres(box.get("size"), "size", (3,))
    if (size < 0).any():
        raise ConfigError(f"size must not be below 0 m, got {size.tolist()}")
    pose = np.eye(4)
    pose[:3, :3] = numbers(box.get("R_world_box"), "R_world_box", (3, 3))
    pose[:3, 3] = numbers(box.get("center"), "center", (3,))
    name = class_of(given.get("class"))
    return box_of(
        size + 2 * QUERY_MARGIN_M,
        id=whole_id(given.get("id")),
        class_name=name,
        shape="box",
        T_world_box=pose_of(pose),
        thing=is_thing(name),
    )
