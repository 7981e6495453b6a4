"""Objects keep their id over visits: what was moved, came or has gone in a house whose plan is known."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import MapError
from semantic_mapper.geometry import invert_pose, yaw_transform
from semantic_mapper.localization.places import DESCRIPTOR_BYTES, Place
from semantic_mapper.mapping.blocks import unpack_keys
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.instances import InstanceTracker, OrientedBox
from semantic_mapper.queries.objects import (
    MAX_OBJECTS,
    MAX_PLACES,
    MapObject,
    ObjectMemory,
    changes_between,
    changes_of,
    remember,
    visit_of,
)
from semantic_mapper.queries.revisit import (
    GONE_FREE,
    PARTS,
    SIGNATURE,
    Candidate,
    Evidence,
    Looked,
    Looks,
    MapVisit,
    color_of,
    lies_along,
    match_candidates,
    may_go,
    pair_costs,
    read_thing,
    signature_of,
    stands,
    touching,
)
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.types import Float64
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.queries.house import LABELS, TRUNCATION, VOXEL_M, Box, house_changes, two_rooms

UP = np.array((0.0, 0.0, 1.0))
TABLE = np.array((5.0, 0.9, 0.35))  # centre of the one that ``two_rooms`` has
CHEST = (0.5, 0.5, 0.4)
BENCH = (1.0, 0.3, 0.3)
DESK = (0.6, 0.4, 0.9)


def box(size: tuple[float, float, float], x: float, y: float, name: str = "table") -> Box:
    """On the floor, with a corner at (x, y)."""
    return name, (x, y, 0.0), (x + size[0], y + size[1], size[2])


def visit(boxes: Sequence[Box], stamp_ns: int, places: Sequence[Place] = ()) -> MapVisit:
    snapshot = MapMirror(VOXEL_M, TRUNCATION, LABELS).apply(house_changes(boxes, 0))
    return MapVisit(snapshot, InstanceTracker(up=UP).update(snapshot, unsure=True), Looks.of(places), stamp_ns)


def two_visits(first: Sequence[Box], second: Sequence[Box]) -> tuple[ObjectMemory, dict[str, list[MapObject]]]:
    """The memory after both, and what it says has changed."""
    memory, before = ObjectMemory(), visit(first, 10)
    memory.update(before, UP)
    assert not changes_of(memory.objects, 10)
    memory.update(visit(second, 20), UP, before=before)
    found: dict[str, list[MapObject]] = {"moved": [], "new": [], "gone": []}
    for change in changes_of(memory.objects, 10):
        found[change.kind].append(change.object)
        assert 0 < change.probability <= 1 and (change.before is None) == (change.kind == "new")
    return memory, found


def test_what_was_moved_came_and_went_is_told_apart() -> None:
    memory, found = two_visits(
        [*two_rooms(), box(CHEST, 0.3, 0.3), box(BENCH, 0.4, 2.3)],
        [*two_rooms(), box(CHEST, 4.0, 2.0), box(DESK, 1.2, 0.2)],
    )
    (chest,), (desk,), (bench,) = (found[kind] for kind in ("moved", "new", "gone"))
    then, now = chest.places
    np.testing.assert_allclose(then.box.center, (0.55, 0.55, 0.2), atol=0.08)
    np.testing.assert_allclose(now.box.center, (4.25, 2.25, 0.2), atol=0.08)
    assert (then.stamp_ns, now.stamp_ns, chest.first_seen_ns, chest.last_seen_ns) == (10, 20, 10, 20)
    assert (bench.gone_ns, bench.last_seen_ns, desk.first_seen_ns, desk.appeared) == (20, 10, 20, True)
    assert chest.id < desk.id and bench.missed >= 1 and chest.missed == 0
    assert bench.present < 0.4 and chest.present == 1 and replace(chest, missed=3).present == 0.25
    (table,) = [o for o in memory.there if np.linalg.norm(o.box.center - TABLE) < 0.1]
    assert table.views == 2 and len(table.places) == 1 and memory.get(table.id) is table


def test_what_no_view_met_again_was_last_seen_before() -> None:
    memory, house = ObjectMemory(), [*two_rooms(), box(CHEST, 0.3, 0.3)]
    memory.update(visit(house, 10), UP)
    later = visit(house, 20)
    east = later.snapshot.packed[unpack_keys(later.snapshot.packed)[:, 0] * 8 * VOXEL_M > 3.5]
    memory.update(later._replace(changed=(east, np.full(len(east), 17))), UP)
    table, chest = sorted(memory.there, key=lambda o: -o.box.center[0])
    assert [(o.last_seen_ns, o.views) for o in (table, chest)] == [(17, 2), (10, 1)]
    loaded = ObjectMemory.from_bytes(memory.to_bytes())
    assert loaded.last_ns == memory.last_ns == 20


def test_a_map_that_goes_on_elsewhere_says_when_a_thing_was_last_seen() -> None:
    made = VoxelMap.received(house_changes(two_rooms(), 0), VOXEL_M, LABELS)
    made.last_stamp_ns = 10
    assert remember(made) is not None
    made.last_stamp_ns = 20
    assert remember(made) is not None
    (table,) = ObjectMemory.from_bytes(made.objects).there
    assert (table.last_seen_ns, table.views) == (10, 1)
    for _ in made.changing(made.changed_stamps(0)[0]):
        pass
    assert remember(made) is not None
    (table,) = ObjectMemory.from_bytes(made.objects).there
    assert (table.last_seen_ns, table.views) == (20, 2)


def test_what_was_brought_back_is_what_was_taken_away() -> None:
    with_bench = [*two_rooms(), box(BENCH, 0.4, 2.3)]
    memory, found = two_visits(with_bench, two_rooms())
    (bench,) = found["gone"]
    memory.update(visit([*two_rooms(), box(BENCH, 1.4, 0.4)], 30), UP, before=visit(two_rooms(), 20))
    (change,) = changes_of(memory.objects, 20)
    assert (change.kind, change.object.id, change.object.gone_ns) == ("moved", bench.id, None)


def test_what_is_put_back_is_what_was_there_and_has_not_moved() -> None:
    memory, with_it, without = ObjectMemory(), [*two_rooms(), box(CHEST, 0.6, 0.6)], two_rooms()
    days = [visit(with_it, 10), visit(without, 20), visit(with_it, 30)]
    memory.update(days[0], UP)
    ids = {o.id for o in memory.there}
    for before, now in pairwise(days):
        memory.update(now, UP, before=before)
    assert {o.id for o in memory.there} == ids
    assert not changes_of(memory.objects, 10)


def test_what_was_joined_from_another_map_can_be_moved_in_time() -> None:
    known, joined = ObjectMemory(), ObjectMemory()
    known.update(visit(two_rooms(), 10), UP)
    joined.join(known)
    assert joined.last_ns == 10
    assert ObjectMemory.from_bytes(joined.moved_by(np.eye(4), -5).to_bytes()).last_ns == 5


def test_maps_of_other_classes_are_not_compared() -> None:
    others = VoxelMap(VoxelMapConfig(), replace(LABELS, name="others"))
    with pytest.raises(MapError, match=r"classes of .*, the earlier one others, of 'others'"):
        changes_between(VoxelMap(VoxelMapConfig(), LABELS), others)


def test_pieces_of_one_class_that_nearly_touch_are_one_thing() -> None:
    turned, size = yaw_transform(np.zeros(3), 90)[:3, :3], np.array((0.2, 0.1, 0.1))  # 0.1 along x
    seat, leg, other, far = (OrientedBox(np.array((x, 0, 0)), size, turned) for x in (0.0, 0.13, 0.26, 0.6))
    assert touching([seat, leg, other, far], [5, 5, 9, 9]) == [[0, 1], [2], [3]]
    slanted = yaw_transform(np.zeros(3), 45)[:3, :3]
    chairs = [OrientedBox(slanted @ (x, 0, 0), np.array((0.4, 0.4, 0.9)), slanted) for x in (0.0, 0.5, 0.92)]
    assert touching(chairs) == [[0], [1, 2]]  # 10 cm apart, 2 cm
    assert sorted(map(sorted, touching([far, seat, other, leg]))) == [[0], [1, 2, 3]]


def test_a_thing_seen_from_another_side_has_not_moved() -> None:
    signature = np.full(SIGNATURE, 9, np.int8)

    def seen(surface: float, box: float) -> Candidate:
        centers = np.array(((surface, 0, 0), (box, 0, 0)))
        return Candidate(5, np.full(3, 0.4), centers, 0.9, signature, np.zeros(3, np.uint8))

    assert not match_candidates([seen(0.0, 0.0)], [seen(0.15, 0.01)])
    assert [pair[:2] for pair in match_candidates([seen(0.0, 0.0)], [seen(0.15, 0.1)])] == [(0, 0)]


def test_what_was_moved_by_half_its_size_left_half_of_its_place() -> None:
    def seen(x: float, free: float) -> Candidate:
        place = np.array((x, 0, 0)) * np.ones((2, 1))
        return Candidate(5, np.full(3, 0.4), place, free, np.full(SIGNATURE, 9, np.int8), np.zeros(3, np.uint8))

    assert match_candidates([seen(0, 0.55)], [seen(0.2, 0.55)])
    assert not match_candidates([seen(0, 0.45)], [seen(0.2, 0.55)])  # one of a row, cut otherwise


def test_of_two_that_left_the_more_alike_is_the_one_that_came() -> None:
    def seen(x: float, hue: int, high: int) -> Candidate:
        signature = np.zeros(SIGNATURE, np.int8)
        signature[[hue, hue + 1, PARTS[0] + high, PARTS[0] + high + 1]] = 90
        place = np.array((x, 0, 0)) * np.ones((2, 1))
        return Candidate(5, np.full(3, 0.4), place, 0.9, signature, np.zeros(3, np.uint8))

    found = match_candidates([seen(0, 0, 1), seen(1, 0, 2), seen(2, 9, 7)], [seen(5, 0, 2), seen(9, 30, 50)])
    assert [pair[:2] for pair in found] == [(1, 0)] and found[0][2] > 0.9
    assert not match_candidates([], [seen(5, 0, 0)]) and not match_candidates([seen(5, 0, 0)], [])


def test_a_signature_tells_where_it_is_light_and_how_wide_it_is() -> None:
    def looks(desk: Box, *, upside_down: bool = False) -> Candidate:
        made = visit([*two_rooms(), desk], 10)
        (thing,) = [t for t in made.things if t.box.center[0] < 2]
        _, slot, voxel = read_thing(made.snapshot, thing)
        is_top = (thing.voxels[:, 2] * VOXEL_M > 0.5) != upside_down
        made.snapshot.voxels.rgb[slot, voxel] = np.where(is_top[:, None], (220, 220, 220), (60, 60, 60))
        signature = signature_of(made.snapshot, thing, UP)
        return Candidate(5, thing.box.size, np.zeros((2, 3)), 0.9, signature, color_of(made.snapshot, thing))

    desk, again = looks(box(DESK, 0.6, 0.6)), looks(box((0.4, 0.6, 0.9), 1.2, 0.6))  # turned by a quarter
    turned, wide = looks(box(DESK, 0.6, 0.6), upside_down=True), looks(box((1.2, 1.0, 0.9), 0.3, 0.2))
    same, light, outline = (pair_costs(Looked.of([desk]), Looked.of([o]))[0] for o in (again, turned, wide))
    assert same < 1 and light > 2 and outline > 2


def test_points_far_from_the_middle_of_a_thing_stay_where_they_can_be_kept() -> None:
    (thing, *_) = full_memory().objects
    long = replace(thing, points=np.array([(30_000, 30_000, 0)], np.int16))
    turned = ObjectMemory([long]).moved_by(yaw_transform(np.zeros(3), 45)).objects[0]
    np.testing.assert_allclose(turned.points, [(0, 32_767, 0)], atol=1)  # and not on the other side


def test_a_part_of_a_surface_lies_along_it_and_one_moved_by_10_cm_does_not() -> None:
    faces = np.stack(np.meshgrid(*[np.linspace(0, 0.3, 11)] * 3), axis=-1).reshape(-1, 3)
    shell = faces[((faces < 0.001) | (faces > 0.299)).any(axis=1)]
    assert lies_along(shell, shell[shell[:, 0] < 0.1]) and lies_along(shell[shell[:, 0] < 0.1], shell)
    assert not lies_along(shell, shell + np.array((0.1, 0, 0)))
    sofa = np.stack(np.meshgrid(np.linspace(0, 2, 12), np.linspace(0, 0.9, 8), [0.8]), axis=-1).reshape(-1, 3)
    assert not lies_along(sofa, sofa + np.array((0.09, 0.06, 0)))  # what is kept of a large thing lies far apart


def test_a_sliver_and_a_speck_are_never_called_gone() -> None:
    boxes = [OrientedBox(np.zeros(3), np.array(size), np.eye(3)) for size in ((0.5, 0.06, 0.02), (0.07, 0.07, 0.25))]
    assert [may_go(box, 60) for box in boxes] == [False, True] and not may_go(boxes[1], 39)


def test_what_only_the_grid_calls_free_counts_less_than_what_a_view_sees_through() -> None:
    free = np.arange(10) < 8
    assert Evidence(free, ~free, 2).free_of == pytest.approx(0.8)
    assert Evidence(free, ~free, 0).free_of < GONE_FREE < 0.8
    assert Evidence(free & False, np.arange(10) < 2, 2).free_of == 0  # too little is known


def test_what_lies_along_a_thing_of_its_class_stands_where_it_stood() -> None:
    house = visit(two_rooms(), 10)
    (table,) = [t for t in house.things if t.class_name == "table"]
    points = table.voxels.astype(np.float64) * VOXEL_M
    nudged, away = (points + np.array(shift) for shift in ((0, 0, 0.04), (0, 2, 0)))
    assert stands(house, table.class_id, nudged) and not stands(house, table.class_id, away)
    assert not stands(house, LABELS.id_of("door"), points)


def test_pieces_that_left_together_are_one_thing() -> None:
    memory, before = ObjectMemory(), visit([*two_rooms(), box(CHEST, 0.3, 0.3)], 10)
    memory.update(before, UP)
    (chest,) = [o for o in memory.there if o.box.size[2] > 0.3 and o.box.center[0] < 1]
    points = np.repeat(chest.points, 2, axis=0)
    low = points[:, 2] < 0
    halves = [replace(chest, points=points[low]), replace(chest, id=99, points=points[~low])]
    memory = ObjectMemory([*(o for o in memory.there if o is not chest), *halves])
    memory.update(visit(two_rooms(), 20), UP, before=before)
    (change,) = changes_of(memory.objects, 10)
    assert change.kind == "gone" and change.object.id in (chest.id, 99)
    np.testing.assert_allclose(change.object.box.size, chest.box.size, atol=0.05)


def test_a_floor_does_not_hide_that_a_flat_thing_has_gone() -> None:
    _, found = two_visits([*two_rooms(), box((0.4, 0.4, 0.1), 0.6, 0.6)], two_rooms())
    assert [len(things) for things in found.values()] == [0, 0, 1]


def test_nothing_has_gone_that_could_not_be_seen() -> None:
    memory, found = two_visits([*two_rooms(), box(CHEST, 4.0, 2.2)], two_rooms(east=False))
    assert found == {"moved": [], "new": [], "gone": []} and len(memory.there) == 2


def test_a_room_seen_for_the_first_time_is_not_full_of_new_things() -> None:
    memory, found = two_visits(two_rooms(east=False), two_rooms())
    assert not found["new"] and [o.appeared for o in memory.there] == [False]


@pytest.mark.parametrize("shift", [(0.02, 0.0, 0.0), (-0.012, 0.012, 0.01), (0.0, 0.03, 0.0)])
def test_a_pose_error_moves_nothing(shift: tuple[float, float, float]) -> None:
    house = [*two_rooms(), box(CHEST, 0.3, 0.3), box(BENCH, 0.4, 2.3)]
    off = [(name, tuple(np.add(low, shift)), tuple(np.add(high, shift))) for name, low, high in house]
    _, found = two_visits(house, off)
    assert found == {"moved": [], "new": [], "gone": []}


def test_a_view_tells_what_is_free_far_from_all_surfaces() -> None:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.array(((0, 0, 1), (-1, 0, 0), (0, -1, 0)))  # along x
    T_world_camera[:3, 3] = (0.3, 0.8, 1.2)
    corners = np.array([(x, y, 2.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0)], np.float32)
    place = Place("front", 5, T_world_camera, corners, np.zeros((4, DESCRIPTOR_BYTES), np.uint8))
    seen = visit(two_rooms(), 10, (place,))
    points = np.array([(1.5, 0.8, 1.2), (1.5, 0.8, 1.3), (3.5, 0.8, 1.2), (0.1, 0.8, 1.2), (0.8, 0.8, 1.2)])
    free, through = seen.looks.through(seen.snapshot, points)
    assert free.tolist() == [1, 1, 0, 0, 0]  # in the room; behind its wall; behind the camera; too near to it
    assert through == 1 and not len(Looks.of((place,), after_ns=5).poses)


def full_memory() -> ObjectMemory:
    memory = ObjectMemory()
    memory.update(visit([*two_rooms(), box(CHEST, 0.3, 0.3)], 10), UP, {})
    return memory


def test_a_memory_is_the_same_after_it_was_saved() -> None:
    memory, _ = two_visits([*two_rooms(), box(CHEST, 0.3, 0.3)], [*two_rooms(), box(CHEST, 4.0, 2.0)])
    loaded = ObjectMemory.from_bytes(memory.to_bytes())
    assert loaded.to_bytes() == memory.to_bytes() and len(loaded) == len(memory) == 2
    for one, other in zip(memory.objects, loaded.objects, strict=True):
        assert (one.id, one.classes, one.class_name, one.views) == (
            other.id,
            other.classes,
            other.class_name,
            other.views,
        )
        np.testing.assert_array_equal(one.signature, other.signature)
        np.testing.assert_allclose(one.surface, other.surface)
        assert [p.stamp_ns for p in one.places] == [p.stamp_ns for p in other.places]
    assert ObjectMemory.from_bytes(b"").objects == ()


def test_a_memory_of_what_is_nowhere_is_refused() -> None:
    memory = full_memory()
    thing = memory.objects[0]
    nowhere = replace(thing, id=99, box=replace(thing.box, center=np.full(3, np.nan)))
    with pytest.raises(MapError, match="damaged"):
        ObjectMemory.from_bytes(ObjectMemory([thing, nowhere]).to_bytes())


def test_maps_in_the_wrong_order_of_their_dates_are_refused() -> None:
    today, yesterday = (VoxelMap.received(house_changes(two_rooms(), 0), VOXEL_M, LABELS) for _ in range(2))
    today.last_stamp_ns, yesterday.last_stamp_ns = 1_700_000_000 * 10**9, 1_700_086_400 * 10**9
    with pytest.raises(MapError, match="the other way round"):
        changes_between(today, yesterday)


@pytest.mark.parametrize("damage", [lambda d: d[:-3], lambda d: d[:10], lambda d: b"\xff\xff\xff\xff" + d[4:]])
def test_a_damaged_memory_is_refused(damage) -> None:
    with pytest.raises(MapError, match="object memory"):
        ObjectMemory.from_bytes(damage(full_memory().to_bytes()))


def test_ten_thousand_objects_take_less_than_50_mb_and_more_are_not_kept() -> None:
    first = full_memory().objects[0]
    places = first.places * MAX_PLACES
    many = [replace(first, id=n + 1, places=places, views=n, signature=first.signature.copy()) for n in range(10_005)]
    memory = ObjectMemory(many)
    memory.join(ObjectMemory())
    assert len(memory) == MAX_OBJECTS and memory.get(1) is None and memory.get(10_005) is not None
    data = memory.to_bytes()
    del memory, many
    tracemalloc.start()
    loaded = ObjectMemory.from_bytes(data)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(loaded) == MAX_OBJECTS and held < 50e6 and len(data) < 50e6


def test_merged_memories_have_what_is_in_both_once() -> None:
    T: Float64 = yaw_transform(np.array((4.0, -3.0, 0.0)), 90.0)
    ours, theirs = full_memory(), ObjectMemory()
    theirs.update(visit([*two_rooms(), box(DESK, 1.2, 0.2)], 30), UP)
    away = ObjectMemory.from_bytes(theirs.to_bytes()).moved_by(invert_pose(T))
    assert np.linalg.norm(away.objects[0].box.center - theirs.objects[0].box.center) > 1
    ours.join(away.moved_by(T))
    chest, table, desk = ours.objects
    assert (table.first_seen_ns, table.last_seen_ns, table.views) == (10, 30, 2)
    assert (chest.last_seen_ns, desk.first_seen_ns, desk.id) == (10, 30, 3)
    np.testing.assert_allclose(desk.box.center, (1.5, 0.4, 0.45), atol=0.08)


def test_ids_outlive_three_visits_saves_and_a_merge() -> None:
    places = [((0.3, 0.3), (0.4, 2.3)), ((4.0, 2.0), (0.4, 2.3)), ((0.3, 0.3), (1.4, 0.4))]  # of the chest, the bench
    houses = [[*two_rooms(), box(CHEST, *chest), box(BENCH, *bench)] for chest, bench in places]
    memory, before, ids = ObjectMemory(), None, list[set[int]]()
    for day, house in enumerate(houses, start=1):
        now = visit(house, 10 * day)
        memory.update(now, UP, before=before)
        memory, before = ObjectMemory.from_bytes(memory.to_bytes()), now
        ids.append({o.id for o in memory.objects})
    other = ObjectMemory()
    other.update(visit(houses[2], 40), UP)
    memory.join(other)
    assert ids == [{1, 2, 3}] * 3 and {o.id for o in memory.objects} == {1, 2, 3}
    changes = changes_of(memory.objects, 20)
    assert [c.kind for c in changes] == ["moved", "moved"] and len(memory.there) == 3
    (table,) = {1, 2, 3} - {c.object.id for c in changes}
    assert [o.views for o in memory.objects if o.id == table] == [4]


def test_stamps_of_a_memory_are_shifted_together() -> None:
    memory, _ = two_visits([*two_rooms(), box(BENCH, 0.4, 2.3)], two_rooms())
    later = memory.moved_by(np.eye(4), later_ns=100)
    kept, shifted = (
        [(o.first_seen_ns, o.last_seen_ns, o.gone_ns, o.places[0].stamp_ns) for o in m.objects] for m in (memory, later)
    )
    assert shifted == [tuple(None if ns is None else ns + 100 for ns in row) for row in kept] and later.last_ns == 120


def test_a_running_mapper_says_what_was_moved_since_the_map_that_it_goes_on_in() -> None:
    def saved(thing: Box, stamp_ns: int) -> VoxelMap:
        made = VoxelMap(VoxelMapConfig(voxel_size_m=VOXEL_M), LABELS)
        made.add(VoxelMap.received(house_changes([*two_rooms(), thing], 0), VOXEL_M, LABELS), np.eye(4))
        made.last_stamp_ns = stamp_ns
        return made

    now = saved(box(CHEST, 0.3, 0.3), 10)
    remember(now)
    before = visit_of(now)
    with (
        a_folder() as folder,
        answering(f"ipc://{folder / 'q'}", now, before=before) as service,
        MapClient(service.endpoint, timeout_s=20.0) as client,
    ):
        first = client.objects()
        assert first.since_ns == 10 and not changes_of(first.objects, 10) and len(first.objects) == 2
        now.take_over(saved(box(CHEST, 4.0, 2.0), 20))
        until = time.monotonic() + 20
        while not (changes := changes_of(client.objects().objects, 10)) and time.monotonic() < until:
            time.sleep(0.05)  # answers are about the map of a moment ago
        (change,) = changes
    assert change.kind == "moved" and change.object.id in {o.id for o in first.objects}
    remembered = ObjectMemory.from_bytes(now.objects).get(change.object.id)
    assert remembered is not None and len(remembered.places) == 2 and remembered.room == change.object.room
