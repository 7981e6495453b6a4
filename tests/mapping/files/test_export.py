from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.files.formats.ply import write_ply
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.open3d_loader import load_open3d

POINTS = MapPoints(
    np.array([[0, 1, 2], [3, 4, 5.5]], np.float32),
    np.array([[1, 2, 3], [250, 251, 252]], np.uint8),
    np.array([7, 0], np.uint8),
    np.array([0.75, 0], np.float32),
)
LABELS = LabelSet("two", (7, 9), ("chair", "table"), ((1, 2, 3), (4, 5, 6)))


def test_ply_has_the_promised_properties_in_order(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, POINTS, LABELS)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    floats, bytes_ = ("x", "y", "z"), ("red", "green", "blue", "label")
    assert names == [*(["float", n] for n in floats), *(["uchar", n] for n in bytes_), ["float", "confidence"]]
    assert b"element vertex 2" in header and len(body) == 2 * (3 * 4 + 4 + 4)
    assert list(tmp_path.iterdir()) == [path]


def test_open3d_reads_it(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", POINTS, LABELS)
    cloud = load_open3d().t.io.read_point_cloud(str(tmp_path / "map.ply"))
    assert (cloud.point.positions.numpy() == POINTS.xyz).all()
    assert (cloud.point.colors.numpy() == POINTS.rgb).all()
    assert (cloud.point["label"].numpy().ravel() == POINTS.label).all()
    assert (cloud.point["confidence"].numpy().ravel() == POINTS.confidence).all()


@pytest.mark.parametrize("name", ["Tür", "a\nend_header", "a\r\x00\x1b[31m", "back\\slash", "椅子", "椅" * 128])
def test_any_class_name_is_one_readable_comment(tmp_path: Path, name: str) -> None:
    """Open3D ends the process at lines of more than 1,000 characters."""
    path = tmp_path / "map.ply"
    write_ply(path, POINTS, LabelSet("odd", (7, 9), (name, "table"), ((1, 2, 3), (4, 5, 6))))
    header = path.read_bytes().split(b"\nend_header\n")[0].decode("ascii").split("\n")
    assert all(line.isprintable() for line in header)
    number, text = header[2].removeprefix("comment label ").split(" ", 1)
    assert number == "7" and header[3] == "comment label 9 table"
    shown = text.encode().decode("unicode_escape")
    assert name.startswith(shown) and (shown == name or 190 < len(text) <= 200)
    cloud = load_open3d().t.io.read_point_cloud(str(path))
    assert (cloud.point["label"].numpy().ravel() == POINTS.label).all()


def test_a_folder_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="nowhere"):
        write_ply(tmp_path / "nowhere" / "map.ply", POINTS, LABELS)
