"""Boxes of KITTI-360: the XML of ``data_3d_bboxes``, as its devkit (``helpers/annotation.py``) reads it.

Each object has ``label``, ``index``, ``transform`` (4x4, may scale), ``vertices``, ``faces``, ``instanceId`` and
``timestamp``. One that moves is there many times, each with the number of a frame of the drive as its timestamp; -1
says that it stands still.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.geometry import MAX_TRANSLATION_M, check_pose
from semantic_mapper.replay.box_values import (
    MAX_TIME,
    BadBox,
    BoxFile,
    box_of,
    each_once,
    is_thing,
    numbers,
    whole_faces,
    whole_id,
)
from semantic_mapper.replay.importers.kitti360 import LABELS
from semantic_mapper.types import Float64

# What labels without these classes take them for: those that the paper (Sec. 4) and the devkit's training ids merge.
MERGE = {
    "sidewalk": ("parking",),
    "building": ("garage",),
    "fence": ("gate",),
    "pole": ("polegroup", "smallpole"),
    "car": ("caravan", "trailer"),
}
_NAMES = {name.replace(" ", ""): name for name in LABELS.names}
_NAMES |= {"driveway": "parking", "ground": "terrain", "bigpole": "pole", "pedestrian": "person"}


def read_kitti360(text: bytes, path: Path) -> BoxFile:
    """Objects, in the order in which they come; each that moves is one box with its poses by frame.

    Raises:
        ConfigError: no XML, or no objects in it.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path} is no XML: {error}") from error
    except (ValueError, LookupError) as error:  # of another character set
        raise ConfigError(f"{path}: cannot be read: {error}; save it as UTF-8") from error
    nodes = [node for node in root if node.find("transform") is not None]
    if not nodes:
        raise ConfigError(f"{path} holds no boxes; give XML of KITTI-360's data_3d_bboxes")
    known = [(n, node) for n, node in enumerate(nodes, 1) if not _text(node, "label").lower().startswith("unknown")]
    good: list[tuple[int, Primitive]] = []
    bad: list[BadBox] = []
    place: dict[tuple[str, str], int] = {}  # in ``good``, of those that move
    for number, node in known:
        try:
            box, frame = _from_node(node)
            if frame is None:
                good.append((number, box))
                continue
            box = replace(box, frames=((frame, box.T_world_box),))
            at = place.setdefault(_object_of(node), len(good))
            if at == len(good):
                good.append((number, box))
            else:
                good[at] = good[at][0], _also(good[at][1], box)
        except (ConfigError, PoseError) as error:
            bad.append(BadBox(number, _number_or_none(_text(node, "index"), 1), str(error)))
    primitives, every_bad = each_once(good, bad)
    return BoxFile(primitives, left_out=len(nodes) - len(known), bad=every_bad, is_xml=True)


def _from_node(node: ElementTree.Element) -> tuple[Primitive, int | None]:
    """One object in axes of its own, and the frame at which it is there, if it moves."""
    transform = _matrix(node, "transform")
    if transform.shape != (4, 4):
        raise ConfigError(f"transform must be 4 x 4, got shape {transform.shape}")
    local, corners = _matrix(node, "vertices"), whole_faces(_matrix(node, "faces", np.inf), None)
    if local.shape[1] != 3 or corners.shape[1] not in (3, 4):
        raise ConfigError(f"vertices must be N x 3 and faces N x 3 or N x 4, got {local.shape} and {corners.shape}")
    pose = np.eye(4)
    pose[:3, :3] = _rotation(transform[:3, :3])
    pose[:3, 3] = transform[:3, 3]
    check_pose(pose, "transform", "box")
    vertices = local @ (pose[:3, :3].T @ transform[:3, :3]).T
    label = _text(node, "label")
    if not label:
        raise ConfigError("<label> is missing")
    name = _class_name(label)
    frame = _whole(node, "timestamp") if _text(node, "timestamp") else -1
    if frame > MAX_TIME:
        raise ConfigError(f"<timestamp> must be the number of a frame, got {frame}")
    box = box_of(
        np.ptp(vertices, axis=0),
        id=whole_id(_whole(node, "index") + 1),
        class_name=name,
        shape="mesh",
        T_world_box=pose,
        thing=is_thing(name),
        vertices=vertices,
        faces=corners if corners.shape[1] == 3 else np.concatenate((corners[:, :3], corners[:, (0, 2, 3)])),
    )
    return box, None if frame < 0 else frame


def _rotation(matrix: Float64) -> Float64:
    """The rotation (3, 3) that is nearest to a matrix that may scale."""
    u, _, v = np.linalg.svd(matrix)
    mirrored = np.linalg.det(u @ v) < 0
    return u @ np.diag((1, 1, -1 if mirrored else 1)) @ v


def _object_of(node: ElementTree.Element) -> tuple[str, str]:
    """What nodes of one object have in common; without a number of the instance, the index."""
    instance = _number_or_none(_text(node, "instanceId"))
    return _text(node, "label"), f"index {_text(node, 'index')}" if not instance else str(instance)


def _also(box: Primitive, later: Primitive) -> Primitive:
    """A box that is also there at another frame, in the shape that it had at first."""
    frames = {**dict(box.frames or ()), **dict(later.frames or ())}
    if len(frames) == len(box.frames or ()):
        raise ConfigError(f"the same object is there already at frame {later.frames[0][0] if later.frames else ''}")
    known = tuple(sorted(frames.items()))
    return replace(box, frames=known, T_world_box=known[0][1])


def _class_name(label: str) -> str:
    """Labels are written without spaces there, and partly have other names."""
    return _NAMES.get(re.sub(r"\s", "", label).lower(), label)


def _text(node: ElementTree.Element, name: str) -> str:
    return (node.findtext(name) or "").strip()


def _number_or_none(text: str, more: int = 0) -> int | None:
    try:
        return int(text) + more
    except ValueError:
        return None


def _whole(node: ElementTree.Element, name: str) -> int:
    number = _number_or_none(_text(node, name))
    if number is None:
        raise ConfigError(f"<{name}> must be a whole number, got '{_text(node, name):.40}'")
    return number


def _matrix(node: ElementTree.Element, name: str, most: float = MAX_TRANSLATION_M) -> Float64:
    found = node.find(name)
    if found is None:
        raise ConfigError(f"<{name}> is missing")
    values = numbers(_text(found, "data").split(), name, (None,), most)
    rows, columns = _whole(found, "rows"), _whole(found, "cols")
    if rows < 1 or columns < 1 or rows * columns != len(values):
        raise ConfigError(f"<{name}> says {rows} x {columns} numbers and holds {len(values)}")
    return values.reshape(rows, columns)
