"""Phrases are read, and mean the right ones of things whose place, colour and size are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError, ShapeError
from semantic_mapper.labels import CAMVID11, NYU40, PROVIDED, ROOMS, make_label_set
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes import map_answers
from semantic_mapper.queries.find import find, open_objects, picture_of, room_kinds
from semantic_mapper.queries.instances import OrientedBox
from semantic_mapper.queries.objects import MapObject, ObjectMemory, ObjectPlace
from semantic_mapper.queries.phrase import SYNONYMS, read_phrase
from semantic_mapper.queries.revisit import SIGNATURE
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.types import Float32, Float64
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import run_ok
from tests.queries.house import LABELS, TRUNCATION, VOXEL_M, house_changes, two_rooms

UP = np.array((0.0, 0.0, 1.0))
NOON = datetime(2026, 3, 5, 12)
MINUTE = 60 * 10**9
# The house's classes, with their ids, and more.
THINGS = make_label_set("things", (*LABELS.names, *"chair sofa refrigerator toilet otherprop otherfurniture".split()))
HOUSE = replace(MapMirror(VOXEL_M, TRUNCATION, LABELS).apply(house_changes(two_rooms(), 0)), label_set=THINGS)
RED, BLUE, GRAY, WHITE = (190, 30, 30), (40, 80, 190), (120, 120, 120), (250, 250, 250)


def at(hour: int, minute: int = 0, day: int = 5) -> int:
    return round(NOON.replace(day=day, hour=hour, minute=minute).timestamp()) * 10**9


def thing(number: int, name: str, center: Sequence[float], size: Sequence[float], **more: Any) -> MapObject:
    """A thing with points all over its box; seen at noon, grey, in no room."""
    box = OrientedBox(np.array(center, float), np.array(size, float), np.eye(3))
    faces = np.stack(np.meshgrid(*[(-0.5, -0.17, 0.17, 0.5)] * 3), axis=-1).reshape(-1, 3)
    faces = faces[np.abs(faces).max(axis=1) == 0.5] * size
    label, room = THINGS.id_of(name), more.get("room")
    seen_ns = more.pop("last_seen_ns", at(12))
    fields: dict[str, Any] = {"color": np.array(more.pop("rgb", GRAY), np.uint8), "classes": ((label, 0.9),), **more}
    return MapObject(
        id=number,
        class_id=label,
        class_name=name,
        box=box,
        signature=np.zeros(SIGNATURE, np.int8),
        points=np.round(faces * 1000).astype(np.int16),
        first_seen_ns=0,
        last_seen_ns=seen_ns,
        views=9,
        places=(ObjectPlace(0, box, room),),
        **{"room": None, **fields},
    )


def ids(text: str, things: Sequence[MapObject], **more: Any) -> list[int]:
    return [found.object.id for found in find(text, HOUSE, things, **{"up": UP, **more})]


def names(classes: Any, labels: Any = THINGS) -> set[str]:
    return {labels.names[labels.ids.index(n)] for n in classes}


@pytest.mark.parametrize(
    ("text", "classes", "rest"),
    [
        ("Where is my couch?", {"sofa"}, ((), (), [], ())),
        ("the big, red chairs", {"chair"}, (("red",), (("size", 1),), [], ())),
        ("a light blue sofa", {"sofa"}, (("blue",), (), [], ())),
        ("a grey fridge in the kitchen", {"refrigerator"}, (("gray",), (), [], ("kitchen",))),
        ("something in room 3 next to a blue sofa", set(THINGS.names), ((), (), [("near", "sofa")], (3,))),
        ("other object on top of the coffee table", {"otherprop"}, ((), (), [("on", "table")], ())),
        ("cup under the table in the living room", {"otherprop"}, ((), (), [("under", "table")], ("living room",))),
        ("furniture by the wall", {"table", "chair", "sofa", "otherfurniture"}, ((), (), [("near", "wall")], ())),
        ("find seats above the floor", {"chair", "sofa"}, ((), (), [("above", "floor")], ())),
    ],
)
def test_a_phrase_is_a_thing_its_looks_relations_and_rooms(text: str, classes: set[str], rest: tuple) -> None:
    found = read_phrase(text, THINGS, at(15))
    assert names(found.thing.classes) == classes and (found.after_ns, found.before_ns) == (None, None)
    (*looks, relations, rooms), noun = rest, found.thing
    assert [noun.colors, noun.sizes] == looks and found.rooms == rooms
    assert [(r, *names(o.classes)) for r, o in found.relations] == relations


@pytest.mark.parametrize(
    ("text", "after", "before"),
    [
        ("chair last seen before noon", None, at(12)),
        ("chair seen after 3 pm", at(15), None),
        ("chair seen before midnight", None, at(0, day=6)),
        ("chair seen after midnight", at(0), None),
        ("chair last seen since yesterday 9:30 and before 8:05am", at(9, 30, day=4), at(8, 5)),
        ("chair seen yesterday", at(0, day=4), at(0)),
        ("chair seen on 2026-03-02", at(0, day=2), at(0, day=3)),
        ("chair seen before 2026-03-02 at 17:00", None, at(17, day=2)),
        ("chair seen in the last 20 minutes", at(18) - 20 * MINUTE, None),
        ("chair in room 3 seen within the past hour", at(18) - 60 * MINUTE, None),
    ],
)
def test_times_are_local_and_of_the_day_of_the_map(text: str, after: int | None, before: int | None) -> None:
    found = read_phrase(text, THINGS, at(18))
    assert (found.after_ns, found.before_ns, names(found.thing.classes)) == (after, before, {"chair"})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("red chiar", "'chiar' is not known; did you mean chair"),
        ("the kitchen", "of a room say 'in the kitchen'"),
        ("toilett", "did you mean toilet or violet\\?"),
        ("a xylophonist", "things are floor, wall"),
        ("chair left of the sofa", "'left of' cannot be answered; relations are near, on"),
        ("chair sofa", "'chair' and 'sofa' are two things"),
        ("the red", "names no thing"),
        ("", "names no thing"),
        ("chair not in the kitchen", "'not' cannot be answered"),
        ("chair near", "'near' needs a thing behind it"),
        ("chair in the", "'in' needs a thing or a room behind it"),
        ("chair seen after 25:00", "is no time"),
        ("chair seen on 9999-12-31", "is no time"),
        ("chair in the garage", "'garage' is not known"),
    ],
)
def test_what_is_not_understood_is_said(text: str, said: str) -> None:
    with pytest.raises(MapError, match=said):
        read_phrase(text, THINGS, at(18))


def test_a_memory_older_than_its_map_is_brought_up_to_the_present(tmp_path: Path) -> None:
    made = VoxelMap.received(house_changes(two_rooms(), 0), VOXEL_M, LABELS)
    made.last_stamp_ns, made.objects = (
        20,
        ObjectMemory([thing(7, "table", (0.5, 2.5, 0.4), (0.4, 0.4, 0.8))]).to_bytes(),
    )
    made.save(tmp_path / "map.npz")
    _, objects = open_objects(tmp_path / "map.npz")
    assert len(objects) == 1
    old = replace(thing(7, "table", (0.5, 2.5, 0.4), (0.4, 0.4, 0.8)), last_seen_ns=10)
    made.objects = ObjectMemory([old]).to_bytes()
    made.save(tmp_path / "map.npz")
    _, objects = open_objects(tmp_path / "map.npz")
    assert [o.id for o in objects] == [7, 8]


def test_a_shade_tells_two_things_of_one_color_apart() -> None:
    things = [thing(n, "chair", (n, 1, 0.5), (0.5, 0.5, 0.9), rgb=rgb) for n, rgb in ((1, BLUE), (2, (144, 184, 224)))]
    things.append(thing(3, "refrigerator", (4, 2, 1), (0.6, 0.6, 1.8), rgb=WHITE))
    assert [ids(f"{shade} blue chair", things)[0] for shade in ("dark", "light", "pale")] == [1, 2, 2]


def test_a_stamp_that_is_no_date_has_no_noon() -> None:
    with pytest.raises(MapError, match="no dates"):
        read_phrase("chair before noon", THINGS, 10**12)
    assert read_phrase("chair in the last minute", THINGS, 10**12).after_ns == 10**12 - MINUTE


def test_each_class_of_each_label_set_has_a_name_that_is_understood() -> None:
    known = {name for labels in PROVIDED.values() for name in labels.names}
    assert {name for line in SYNONYMS.values() for name in line.strip("+").split()} <= known
    for labels in PROVIDED.values():
        for name in labels.names:
            assert name in names(read_phrase(name, labels, 0).thing.classes, labels), (labels.name, name)
    assert names(read_phrase("person", CAMVID11, 0).thing.classes, CAMVID11) == {"pedestrian"}
    assert names(read_phrase("dressers", NYU40, 0).thing.classes, NYU40) == {"dresser"}
    assert names(read_phrase("dresser", ROOMS, 0).thing.classes, ROOMS) == {"cabinet"}


CHAIR = (0.5, 0.5, 0.9)
KITCHEN = [
    thing(1, "chair", (0.5, 0.5, 0.45), CHAIR, rgb=RED, room=1),
    thing(2, "chair", (2.5, 2.5, 0.45), CHAIR, rgb=GRAY, room=1),
    thing(3, "chair", (5.0, 1.6, 0.45), (0.6, 0.6, 1.3), rgb=RED, room=2, last_seen_ns=at(9)),
    thing(4, "refrigerator", (1.6, 2.5, 0.9), (0.7, 0.7, 1.8), rgb=WHITE, room=1),
    thing(5, "table", (5.0, 0.9, 0.35), (0.8, 0.6, 0.7), room=2),
    thing(6, "otherprop", (5.0, 0.9, 0.76), (0.1, 0.1, 0.12), rgb=BLUE, room=2),
    thing(7, "otherprop", (5.0, 0.9, 0.06), (0.1, 0.1, 0.12), rgb=BLUE, room=2, gone_ns=at(12), certainty=0.7),
    thing(8, "toilet", (5.8, 2.5, 0.3), (0.4, 0.6, 0.6), rgb=WHITE, room=2),
    thing(9, "otherprop", (3.6, 2.9, 1.5), (0.3, 0.05, 0.3), room=2),
]


@pytest.mark.parametrize(
    ("text", "first", "all_"),
    [
        ("red chair", 1, {1, 3}),
        ("chair in the kitchen", 1, {1, 2, 3}),
        ("red chair in the bathroom", 3, {3, 1}),
        ("gray chair in room 1", 2, {2}),
        ("tall chair", 3, {3, 1, 2}),
        ("the largest chair", 3, {3, 1, 2}),
        ("smallest chair in the bathroom", 3, {3, 1, 2}),
        ("the smallest thing", 6, {6, 7}),  # what is far larger is not listed
        ("object on the smallest table", 6, {6}),
        ("chair near the table", 3, {3}),
        ("chair near the fridge", 2, {2}),
        ("object on the table", 6, {6}),
        ("object under the table", 7, {7}),
        ("red chair on the floor", 1, {1, 3}),
        ("dark chair", 1, {1, 3, 2}),
        ("what is on the table?", 6, {6}),
        ("chair in the room", 1, {1, 2, 3}),
        ("where did I last see an other object under the table", 7, {7}),
        ("other object on the wall", 9, {9}),
        ("chair last seen before noon", 3, {3}),
        ("white thing in room 2", 8, {8, 5, 9}),
        ("sofa", None, set()),
    ],
)
def test_the_likeliest_thing_comes_first(text: str, first: int | None, all_: set[int]) -> None:
    found = ids(text, KITCHEN, limit=9)
    assert found[:1] == ([first] if first else []) and set(found) <= all_, found


def test_probabilities_are_products_of_parts_and_of_what_is_still_there() -> None:
    there, gone = (next(a for a in find("other object", HOUSE, KITCHEN, up=UP) if a.object.id == n) for n in (6, 7))
    assert there.probability == pytest.approx(0.9) and gone.probability == pytest.approx(0.9 * 0.3)
    (red, *_) = find("red chair in the kitchen near the wall", HOUSE, KITCHEN, up=UP)
    assert list(red.parts) == ["class", "color", "kitchen", "there", "near wall"]
    assert red.probability == pytest.approx(np.prod(list(red.parts.values()))) and red.room_kind == "kitchen"
    missed = [replace(KITCHEN[1], missed=1)]
    assert find("chair", HOUSE, missed, up=UP)[0].parts["there"] == pytest.approx(0.5)
    kinds = room_kinds(KITCHEN)
    assert kinds[1]["kitchen"] > 0.5 and kinds[2]["bathroom"] > 0.8
    assert all(sum(kind.values()) == pytest.approx(1) for kind in kinds.values())


def test_a_thing_in_no_known_room_may_be_in_any() -> None:
    nowhere = [replace(KITCHEN[0], id=12, room=None)]
    assert find("chair in room 1", HOUSE, nowhere, up=UP)[0].parts["room 1"] == pytest.approx(0.2)
    assert ids("chair in the kitchen", [*nowhere, *KITCHEN])[:3] == [1, 2, 12]


def test_what_has_gone_for_sure_is_found_where_it_was_last_seen() -> None:
    gone = [replace(KITCHEN[4], gone_ns=at(12), certainty=1.0)]
    assert ids("table", gone) == [] and ids("where did you last see the table", gone) == [5]
    assert ids("table last seen before midnight", gone) == [5]


def test_what_has_no_class_of_its_own_is_said_to_have_none() -> None:
    found = {text: map_answers.answer_find(text, find(text, HOUSE, KITCHEN, up=UP)) for text in ("cup", "chair")}
    assert "many kinds" in found["cup"]["note"] and found["cup"]["answers"] and "note" not in found["chair"]


def test_a_thing_is_seen_from_free_floor_of_its_room_or_from_nowhere() -> None:
    (table,) = find("table", HOUSE, KITCHEN)
    T = table.T_world_camera
    assert T is not None
    x, y, z = T[:3, 3]
    assert 3.35 < x < 5.85 and 0.25 < y < 2.75 and z == pytest.approx(1.2, abs=0.05)  # 25 cm from the walls
    to = table.object.box.center - T[:3, 3]
    assert np.hypot(*to[:2]) > 0.7 and T[:3, 2] @ to == pytest.approx(np.linalg.norm(to))
    outside = thing(1, "table", (20.0, 0.9, 0.35), (0.8, 0.6, 0.7))
    (unseen,) = find("table", HOUSE, [outside], up=UP)
    assert unseen.T_world_camera is None
    picture = picture_of(HOUSE, table, UP)
    marked = (picture.astype(int) @ (1, 1, 1) > 30).nonzero()  # the house is black
    assert picture.shape == (240, 320, 3) and 0.3 < len(marked[0]) / (240 * 320) * 10 < 1.5
    for axis, size in zip(marked, picture.shape, strict=False):  # the box is in the middle, and fills most of it
        assert abs(axis.min() + axis.max() - size) < 0.2 * size and np.ptp(axis) > 0.4 * size
    nothing = picture_of(HOUSE, unseen, UP)
    assert 0.85 < (nothing == 230).all(axis=2).mean() < 1 and (nothing[..., 2] < 100).any()


class Letters:
    """Counts known words; of one meaning are words of one column."""

    WORDS = ("perch chair", "settee sofa", "icebox refrigerator", "table", "a")

    def encode(self, texts: Sequence[str]) -> Float32:
        rows: Float64 = np.array(
            [[sum(w in t.split() for w in words.split()) for words in self.WORDS] for t in texts], float
        )
        rows[:, -1] = 0.1
        return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_a_text_encoder_takes_the_place_of_synonyms() -> None:
    with pytest.raises(MapError, match="perch"):
        ids("red perch", KITCHEN)
    assert ids("red perch in the kitchen", KITCHEN, encoder=Letters())[0] == 1
    assert ids("white icebox near the perch", KITCHEN, encoder=Letters())[0] == 4
    found = read_phrase("icebox", THINGS, 0, Letters()).thing.classes
    assert sum(found.values()) == pytest.approx(1) and found[THINGS.id_of("refrigerator")] > 0.99

    class Bad(Letters):
        def encode(self, texts: Sequence[str]) -> Float32:
            return 2 * super().encode(texts)

    with pytest.raises(ShapeError, match="unit vectors"):
        ids("chair", KITCHEN, encoder=Bad())


def test_a_running_mapper_finds_what_its_saved_map_has(tmp_path: Any) -> None:
    now = VoxelMap.received(house_changes(two_rooms(), 0), VOXEL_M, LABELS)
    now.save(tmp_path / "map.npz")
    snapshot, objects = open_objects(tmp_path / "map.npz")
    (saved,) = find("table in room 2 on the floor", snapshot, objects)
    folder, mine = tmp_path / "found", tmp_path / "found" / "my_object_1.png"
    folder.mkdir()
    for old in (mine, folder / "5_object_9.png"):
        old.touch()
    run_ok("query", tmp_path / "map.npz", "find", "table", "--pictures", folder)
    assert set(folder.iterdir()) == {mine, folder / f"1_object_{saved.object.id}.png"}, "none of an earlier answer"
    with (
        a_folder() as folder,
        answering(f"ipc://{folder / 'q'}", now) as service,
        MapClient(service.endpoint, timeout_s=20.0) as client,
    ):
        (live,) = client.find("table in room 2 on the floor")
    assert live.parts == saved.parts and live.object.id == saved.object.id
    np.testing.assert_allclose(live.T_world_camera, saved.T_world_camera)  # type: ignore[arg-type]
