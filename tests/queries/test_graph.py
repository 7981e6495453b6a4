"""Floors, rooms, doors and things of houses whose plans are known."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.queries.graph import GraphTracker, SceneGraph, draw_graph
from semantic_mapper.queries.rooms import part_rooms
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.types import Bool, Float64
from tests.queries.house import AIR, LABELS, STOREY_M, TRUNCATION, UPRIGHT, VOXEL_M, Box, house_changes, two_rooms

CELL_M = 0.05


def graph_of(boxes: list[Box], tracker: GraphTracker, R_world_house: Float64 = UPRIGHT) -> SceneGraph:
    mirror = MapMirror(VOXEL_M, TRUNCATION, LABELS)
    return tracker.update(mirror.apply(house_changes(boxes, 0, R_world_house)))


def test_two_rooms_a_door_and_a_table() -> None:
    graph = graph_of(two_rooms(), GraphTracker())
    assert len(graph.floors) == 1 and graph.floors[0].height_m == pytest.approx(0.0, abs=0.03)
    west, east = sorted(graph.rooms, key=lambda room: room.center[0])
    assert {west.id, east.id} == {1, 2} == set(graph.floors[0].rooms)
    for room, x in ((west, 1.5), (east, 4.6)):
        assert room.area_m2 == pytest.approx(9.0, rel=0.1)
        np.testing.assert_allclose(room.outline.min(axis=0), (x - 1.5, 0.0, 0.0), atol=0.15)
        np.testing.assert_allclose(room.outline.max(axis=0), (x + 1.5, 3.0, 0.0), atol=0.15)
    (door,) = graph.doors
    assert door.rooms == (1, 2) and door.width_m == pytest.approx(0.8, abs=0.11)
    np.testing.assert_allclose(door.center, (3.05, 1.5, 0.0), atol=0.15)
    (table,) = graph.things
    assert table.class_name == "table" and graph.room_of == {table.id: east.id}
    assert draw_graph("house", graph).shape[2] == 3


def test_storeys_are_floors_of_their_own() -> None:
    graph = graph_of([*two_rooms(), *two_rooms(STOREY_M)], GraphTracker())
    assert [floor.height_m for floor in graph.floors] == pytest.approx([0.0, STOREY_M], abs=0.03)
    assert [len(floor.rooms) for floor in graph.floors] == [2, 2] and len(graph.rooms) == 4
    rooms = {room.id: room for room in graph.rooms}
    for thing in graph.things:
        room = graph.room_of[thing.id]
        assert room is not None and rooms[room].center[0] > 3
        assert rooms[room].center[2] == pytest.approx(thing.box.center[2] - 0.35, abs=0.1)
    assert len(graph.things) == 2


def test_up_may_be_any_axis() -> None:
    R_world_house = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))  # up is y
    given = graph_of(two_rooms(), GraphTracker((0.0, 1.0, 0.0)), R_world_house)
    graph = graph_of(two_rooms(), GraphTracker(), R_world_house)  # up is where the floor is not
    assert graph.up.tolist() == given.up.tolist() == [0, 1, 0] and len(given.rooms) == 2
    assert len(graph.rooms) == 2 and len(graph.doors) == 1
    np.testing.assert_allclose(R_world_house.T @ graph.doors[0].center, (3.05, 1.5, 0.0), atol=0.15)
    assert list(graph.room_of.values()) == [max(graph.rooms, key=lambda room: room.center[0]).id]


def test_ids_stay_while_the_map_grows() -> None:
    tracker = GraphTracker()
    (west,) = graph_of(two_rooms(east=False), tracker).rooms
    assert west.id == 1
    west, east = sorted(graph_of(two_rooms(), tracker).rooms, key=lambda room: room.center[0])
    assert (west.id, east.id) == (1, 2)
    upper = graph_of([*two_rooms(-STOREY_M), *two_rooms()], tracker)  # what comes first by height is new
    assert [(floor.id, floor.rooms) for floor in upper.floors] == [(2, (3, 4)), (1, (1, 2))]
    joined = graph_of(two_rooms(door_m=1.6), tracker)
    assert [room.id for room in joined.rooms] == [1]
    assert {room.id for room in graph_of(two_rooms(), tracker).rooms} == {1, 5}  # an id is never given twice


def test_a_map_without_floor_has_no_rooms() -> None:
    walls = [box for box in two_rooms() if box[0] in ("wall", "ceiling", AIR)]
    graph = graph_of(walls, GraphTracker((0, 0, 1)))
    assert graph.floors == graph.rooms == graph.doors == ()
    with pytest.raises(MapError, match="which way is up"):
        graph_of(walls, GraphTracker())
    with pytest.raises(MapError, match="up"):
        GraphTracker((0, 0))


def plan(wall: list[tuple[int, int, int, int]], size: tuple[int, int] = (64, 124)) -> tuple[Bool, Bool]:
    """Floor all over, and walls [row0, row1) x [column0, column1), the outer ones among them."""
    seen, walls = np.ones(size, np.bool_), np.zeros(size, np.bool_)
    walls[:2] = walls[-2:] = walls[:, :2] = walls[:, -2:] = True
    for row0, row1, column0, column1 in wall:
        walls[row0:row1, column0:column1] = True
    return seen, walls


@pytest.mark.parametrize(("gap", "rooms"), [(14, 2), (18, 2), (26, 1)])
def test_rooms_part_at_doors(gap: int, rooms: int) -> None:
    seen, wall = plan([(0, 20, 60, 63), (20 + gap, 64, 60, 63)])
    found = part_rooms(seen, wall, CELL_M)
    assert found.rooms == rooms and (found.room[~wall] >= 0).all() and (found.room[wall] == -1).all()
    assert [p.width_m for p in found.passages] == pytest.approx([gap * CELL_M] * (rooms - 1), abs=0.11)


@pytest.mark.parametrize(
    ("rows", "columns", "rooms"),
    [((10, 20), (40, 60), 1), ((0, 64), (60, 70), 1), ((0, 64), (60, 76), 2)],  # behind furniture, from wall to wall
)
def test_a_narrow_part_that_was_not_seen_belongs_to_the_room(
    rows: tuple[int, int], columns: tuple[int, int], rooms: int
) -> None:
    seen, wall = plan([])
    seen[slice(*rows), slice(*columns)] = False
    found = part_rooms(seen, wall, CELL_M)
    assert found.rooms == rooms and (rooms > 1 or (found.room[~wall] == 0).all())
