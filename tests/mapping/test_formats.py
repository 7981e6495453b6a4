"""Exported files, read back by readers of our own and by Open3D: a scene that no mirror or turn leaves as it is."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.floor_plan import find_up
from semantic_mapper.mapping.formats import colored, sure_faces, sure_points, write_glb, write_ply
from semantic_mapper.mapping.map_types import MapMesh, MapPoints
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.types import Float64
from tests.mapping.rendered_views import LABELS

# Four corners at different distances from the origin along +x, +y, +z: every mirror or turn moves one of them.
MESH = MapMesh(
    np.array([[0.5, 0.25, -3], [1.5, 0.25, -3], [0.5, 2.25, -3], [0.5, 0.25, 1.0]], np.float32),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3]], np.int32),
    np.array([[255, 0, 10], [1, 128, 2], [7, 9, 200], [90, 91, 92]], np.uint8),
    np.array([5, 9, 9, 0], np.uint8),
    np.array([0.75, 0.5, 1, 0], np.float32),
)
POINTS = MapPoints(MESH.vertices, MESH.rgb, MESH.label, MESH.confidence)
UP_Z = np.array((0.0, 0.0, 1.0))


def read_glb(path: Path) -> dict[str, np.ndarray]:
    """The attributes and indices of the first primitive, with the checks that a strict reader makes."""
    data = path.read_bytes()
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and binary_size % 4 == 0 and 28 + size + binary_size == total
    binary = data[28 + size :]
    assert document["asset"]["version"] == "2.0" and document["buffers"] == [{"byteLength": binary_size}]
    dtypes = {5123: np.dtype("<u2"), 5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
    widths = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 4
    out: dict[str, np.ndarray] = {}
    for name, n in {**primitive["attributes"], "indices": primitive["indices"]}.items():
        accessor = document["accessors"][n]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(dtypes[accessor["componentType"]]), widths[accessor["type"]]
        stride = view.get("byteStride", dtype.itemsize * width)
        assert view["byteOffset"] % 4 == 0 and (name == "indices" or stride % 4 == 0)
        assert accessor["count"] * stride <= view["byteLength"] <= binary_size - view["byteOffset"]
        raw = np.frombuffer(binary, np.uint8, accessor["count"] * stride, view["byteOffset"]).reshape(-1, stride)
        values = np.ascontiguousarray(raw[:, : dtype.itemsize * width]).view(dtype)
        out[name] = values if width > 1 else values[:, 0]
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    assert position["min"] == out["POSITION"].min(axis=0).tolist()
    assert position["max"] == out["POSITION"].max(axis=0).tolist()
    return out


def to_srgb(color: np.ndarray) -> np.ndarray:
    linear = color[:, :3] / 65535
    return np.rint(255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


def test_glb_holds_places_and_colours_and_open3d_reads_it_with_y_up(tmp_path: Path) -> None:
    write_glb(tmp_path / "map.glb", MESH, UP_Z)
    read = read_glb(tmp_path / "map.glb")
    np.testing.assert_array_equal(read["POSITION"], MESH.vertices)
    np.testing.assert_array_equal(read["indices"].reshape(-1, 3), MESH.faces)
    np.testing.assert_array_equal(to_srgb(read["COLOR_0"]), MESH.rgb)
    assert (read["COLOR_0"][:, 3] == 65535).all()
    assert list(tmp_path.iterdir()) == [tmp_path / "map.glb"]
    model = load_open3d().io.read_triangle_model(str(tmp_path / "map.glb"))
    mesh = model.meshes[0].mesh
    x, y, z = MESH.vertices[MESH.faces].reshape(-1, 3).T
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)].reshape(-1, 3)
    np.testing.assert_allclose(corners, np.stack((x, z, -y), axis=1), atol=1e-6)  # no mirror


def test_open3d_reads_ply_meshes(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", MESH, LABELS)
    o3d = load_open3d()
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "map.ply"))
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    order, expected = (np.lexsort(c.reshape(-1, 9).T) for c in (corners, MESH.vertices[MESH.faces]))
    np.testing.assert_allclose(corners[order], MESH.vertices[MESH.faces][expected], atol=1e-6)
    vertices = o3d.t.io.read_point_cloud(str(tmp_path / "map.ply")).point  # the mesh reader drops what it knows not
    assert (vertices["label"].numpy().ravel() == MESH.label).all()
    assert (vertices["colors"].numpy() == MESH.rgb).all()
    assert (vertices["confidence"].numpy().ravel() == MESH.confidence).all()


def test_ply_says_what_its_labels_mean(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", POINTS, LABELS)
    comments = [line for line in (tmp_path / "map.ply").read_bytes().split(b"\n") if line.startswith(b"comment")]
    classes = (b"5 table", b"9 cup", b"2 wall", b"0 unknown")
    assert comments == [b"comment label " + text for text in classes]
    cloud = load_open3d().t.io.read_point_cloud(str(tmp_path / "map.ply"))
    assert (cloud.point.positions.numpy() == POINTS.xyz).all()


def test_points_and_meshes_say_what_was_measured_where_something_was_computed(tmp_path: Path) -> None:
    some, all_ = np.array([True, False, False, True]), np.ones(4, np.bool_)
    for measured, said in ((some, True), (all_, False)):
        for surface in (POINTS, MESH):
            write_ply(tmp_path / "map.ply", replace(surface, measured=measured), LABELS)
            point = load_open3d().t.io.read_point_cloud(str(tmp_path / "map.ply")).point
            assert ("measured" in point) == said and (not said or (point["measured"].numpy().ravel() == some).all())


def test_colours_and_confidence_choose_what_is_seen() -> None:
    painted = colored(POINTS, LABELS, "class")
    assert painted.rgb[:2].tolist() == [list(LABELS.colors[0]), list(LABELS.colors[1])]
    assert painted.rgb[3].tolist() == [0, 0, 0] and (painted.label == POINTS.label).all()
    brightness = colored(POINTS, LABELS, "confidence").rgb.astype(int).sum(axis=1)
    assert np.argsort(brightness).tolist() == np.argsort(POINTS.confidence).tolist()
    assert colored(MESH, LABELS, "rgb") is MESH
    assert sure_points(POINTS, 0.75).label.tolist() == [5, 9] and len(sure_points(POINTS, 0).label) == 4
    sure = sure_faces(MESH, 0.5)
    np.testing.assert_array_equal(sure.vertices[sure.faces], MESH.vertices[[[0, 2, 1]]])
    assert sure.label.tolist() == [5, 9, 9]


def a_room(R_world_room: Float64) -> MapPoints:
    """Floor and, twice as densely, a ceiling, and a wall; z up in the room; some of the wall is called floor."""
    rng = np.random.default_rng(3)
    floor = np.column_stack((rng.uniform(0, 4, 4000), rng.uniform(0, 3, 4000), np.zeros(4000)))
    ceiling = np.column_stack((rng.uniform(0, 4, 8000), rng.uniform(0, 3, 8000), np.full(8000, 2.5)))
    wall = np.column_stack((rng.uniform(0, 4, 6000), np.zeros(6000), rng.uniform(0, 2.5, 6000)))
    xyz = np.concatenate((floor, ceiling, wall)) @ R_world_room.T
    label = np.repeat(np.array((2, 3, 2, 1), np.uint8), (4000, 8000, 700, 5300))
    n = len(xyz)
    return MapPoints(xyz.astype(np.float32), np.zeros((n, 3), np.uint8), label, np.ones(n, np.float32))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.36, 0.48, -0.8)])
def test_up_is_away_from_the_floor(up: tuple[float, float, float]) -> None:
    found = find_up(a_room(turn_onto(UP_Z, np.array(up, np.float64))), ROOMS)
    assert np.rad2deg(np.arccos(min(found @ up, 1.0))) < 0.3
    if max(up) == 1 or min(up) == -1:
        np.testing.assert_array_equal(found, up)  # an axis of the world, exactly


def test_no_up_is_better_than_a_wrong_one() -> None:
    room = a_room(np.eye(3))
    with pytest.raises(MapError, match="too little of the map is labelled floor; map more"):
        find_up(room, LABELS)
    mixed = np.random.default_rng(4).permutation(room.label)
    with pytest.raises(MapError, match="in no plane"):
        find_up(MapPoints(room.xyz, room.rgb, mixed, room.confidence), ROOMS)
