"""Floor plans of a room whose free and occupied cells are known, seen through a real map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import look_at, turn_onto
from semantic_mapper.mapping.floor_plan import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, occupancy_grid, write_map_server
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import CameraIntrinsics, Float32, Float64
from tests.mapping.rendered_views import frame, ray_directions, small_map

WIDE = CameraIntrinsics(80.0, 80.0, 79.5, 59.5, 160, 120)
UP = np.array((0.0, 0.0, 1.0))
ROOM = np.array(((-1.0, -2.0, 0.0), (2.0, 0.0, 2.2)))  # low and high corner, metres
BOXES = {  # low and high corners
    "crate": ((-1.0, -2.0, 0.0), (-0.4, -1.5, 0.6)),  # in the corner of low x, low y
    "sill": ((1.0, -2.0, 0.0), (1.2, 0.0, 0.06)),  # lower than LOW: a robot drives over it
    "lamp": ((1.3, -1.2, 1.6), (1.7, -0.8, 2.2)),  # higher than HIGH
}
HEIGHT = (0.1, 1.2)


def room_depth(T_world_camera: Float64) -> Float32:
    """Depth in the room, by slabs: where a ray leaves the room, or first enters a box."""
    d = ray_directions(WIDE, T_world_camera)
    o = T_world_camera[:3, 3]

    def slabs(low: Float64, high: Float64) -> tuple[Float64, Float64]:
        a, b = (low - o) / d, (high - o) / d
        return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)

    _, z = slabs(*ROOM)
    for low, high in BOXES.values():
        enters, leaves = slabs(np.array(low), np.array(high))
        z = np.where((enters > 0) & (enters < leaves), np.minimum(z, enters), z)
    return z.astype(np.float32)


def seen_from_all_round(T_map_room: Float64) -> MapPoints:
    voxel_map = small_map()
    for n, angle in enumerate(np.arange(0, 2 * np.pi, np.pi / 4)):
        for down in (-0.5, 0.35, 1.1, 3.0):
            eye = np.array((0.5 + 0.2 * np.cos(angle), -1.0 + 0.2 * np.sin(angle), 1.3))
            pose = look_at(eye, eye + np.array((np.cos(angle), np.sin(angle), -down)), UP)
            shot = frame(T_map_room @ pose, seq=n, intrinsics=WIDE)
            voxel_map.integrate(shot, room_depth(pose), None, None)
    return voxel_map.points()


@pytest.fixture(scope="module")
def room() -> MapPoints:
    return seen_from_all_round(np.eye(4))


def centres(grid: OccupancyGrid) -> tuple[Float64, Float64]:
    rows, columns = np.indices(grid.cells.shape)
    x, y = grid.origin_m
    return x + (columns + 0.5) * grid.resolution_m, y + (rows + 0.5) * grid.resolution_m


def inside(x: Float64, y: Float64, low: tuple[float, ...], high: tuple[float, ...], margin: float) -> Float64:
    return (x > low[0] - margin) & (x < high[0] + margin) & (y > low[1] - margin) & (y < high[1] + margin)


def check_room(grid: OccupancyGrid) -> None:
    """Everything is as in the room, but for cells that a border runs through."""
    x, y = centres(grid)
    crate = inside(x, y, *BOXES["crate"], -0.05)
    floor = inside(x, y, ROOM[0], ROOM[1], -0.05) & ~inside(x, y, *BOXES["crate"], 0.05)
    assert crate.sum() > 60 and (grid.cells[crate] == OCCUPIED).all()
    assert floor.sum() > 1500 and (grid.cells[floor] == FREE).mean() > 0.995
    assert not (grid.cells[floor] == OCCUPIED).any(), "sill and lamp are in nobody's way"
    wall = np.abs(x - 2.0) < 0.026
    assert (grid.cells[wall & (y > -1.9) & (y < -0.1)] == OCCUPIED).any()
    for column in np.unique(np.round(x[floor], 6)):  # no way out through a wall
        of_column = grid.cells[:, int(np.argmin(np.abs(x[0] - column)))]
        assert of_column[:3].max() == OCCUPIED and of_column[-3:].max() == OCCUPIED
    assert not (grid.cells[~inside(x, y, ROOM[0], ROOM[1], 0.06)] == FREE).any()


def test_plan_of_a_room(room: MapPoints) -> None:
    grid = occupancy_grid(room, UP, 0.05, HEIGHT)
    assert abs(grid.T_grid_world[2, 3]) < 0.005 and (grid.T_grid_world[:2] == np.eye(4)[:2]).all()
    check_room(grid)


def test_a_hole_in_the_floor_is_unknown_not_free(room: MapPoints) -> None:
    hole = (np.abs(room.xyz[:, 0] - 1.5) < 0.2) & (np.abs(room.xyz[:, 1] + 1) < 0.3) & (room.xyz[:, 2] < 0.5)
    without = MapPoints(*(getattr(room, name)[~hole] for name in MapPoints.__slots__))
    grid = occupancy_grid(without, UP, 0.05, HEIGHT)
    x, y = centres(grid)
    assert (grid.cells[inside(x, y, (1.3, -1.3), (1.7, -0.7), -0.03)] == UNKNOWN).all()


def test_map_server_files_read_as_nav2_reads_them(tmp_path: Path) -> None:
    cells = np.array([[FREE, OCCUPIED, UNKNOWN], [FREE, FREE, UNKNOWN]], np.int8)  # the second row has the larger y
    T = np.eye(4)
    T[:3, :3] = turn_onto(np.array((0.0, -1.0, 0.0)), UP)
    written = write_map_server(tmp_path / "plan.pgm", OccupancyGrid(cells, 0.05, (-1.25, 3.5), T))
    assert written == (tmp_path / "plan.yaml", tmp_path / "plan.pgm")
    keys = dict(line.split(": ", 1) for line in (tmp_path / "plan.yaml").read_text().splitlines())
    values = {k: json.loads(v) for k, v in keys.items() if k != "mode"}  # flow style YAML is JSON
    assert keys["mode"] == "trinary" and values["image"] == "plan.pgm" and values["negate"] == 0
    assert values["resolution"] == 0.05 and values["origin"] == [-1.25, 3.5, 0.0]
    np.testing.assert_allclose(values["T_grid_world"], T, atol=1e-9)
    header, size, most, body = (tmp_path / "plan.pgm").read_bytes().split(b"\n", 3)
    assert (header, size, most) == (b"P5", b"3 2", b"255") and len(body) == 6
    picture = np.frombuffer(body, np.uint8).reshape(2, 3)
    fraction = (255 - picture.astype(np.float64)) / 255
    read = np.where(fraction > values["occupied_thresh"], 100, np.where(fraction < values["free_thresh"], 0, -1))
    np.testing.assert_array_equal(read[::-1], cells)  # the first row of a picture is its top


def test_a_cell_costs_as_much_as_the_dearest_surface_in_it(tmp_path: Path) -> None:
    floor, rug, table, chair = 1, 2, 3, 4
    at = [(0, 0, 0, floor), (1, 0, 0, rug), (2, 0, 0, floor), (2, 0, 0.7, table), (3, 0, 0.4, chair), (3, 0, 0, rug)]
    at += [(4, 1, 0, floor)]  # the cells above the first four are unknown
    xyz, label = np.array([a[:3] for a in at], np.float32) + np.float32(0.5), np.array([a[3] for a in at], np.uint8)
    points = MapPoints(xyz, np.zeros((len(at), 3), np.uint8), label, np.ones(len(at), np.float32))
    costs = np.full(256, -1)
    costs[[rug, chair]] = 20, 60
    grid = occupancy_grid(points, UP, 1.0, HEIGHT, floor_m=0.5, cost_of=costs)
    assert grid.costs is not None
    assert grid.costs.tolist() == [[0, 20, 100, 60, -1], [-1, -1, -1, -1, 0]]
    written = write_map_server(tmp_path / "plan.yaml", grid)
    assert [path.name for path in written] == ["plan.yaml", "plan.pgm", "plan_costs.yaml", "plan_costs.pgm"]
    text = (tmp_path / "plan_costs.yaml").read_text()
    assert "mode: raw\n" in text and 'image: "plan_costs.pgm"\n' in text
    body = (tmp_path / "plan_costs.pgm").read_bytes().split(b"\n", 3)[3]
    assert list(body) == [255, 255, 255, 255, 0, 0, 20, 100, 60, 255]
    assert occupancy_grid(points, UP, 1.0, HEIGHT, floor_m=0.5).costs is None


def test_impossible_plans_are_refused(room: MapPoints) -> None:
    for height in ((0.0, 1.0), (0.5, 0.4), (0.1, np.inf)):
        with pytest.raises(MapError, match="height band"):
            occupancy_grid(room, UP, 0.05, height)
    for resolution in (0.0, 0.04, np.nan, np.inf):
        with pytest.raises(MapError, match="resolution"):
            occupancy_grid(room, UP, 0.05, HEIGHT, resolution_m=resolution)
    with pytest.raises(MapError, match="no surface between"):
        occupancy_grid(room, UP, 0.05, HEIGHT, floor_m=20.0)
    with pytest.raises(MapError, match="larger cells"):
        occupancy_grid(room, UP, 1e-5, HEIGHT, resolution_m=1e-4)
    with pytest.raises(MapError, match="without surface"):
        occupancy_grid(MapPoints(*(getattr(room, n)[:0] for n in MapPoints.__slots__)), UP, 0.05, HEIGHT)
