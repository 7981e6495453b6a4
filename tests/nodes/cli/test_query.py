"""The command on a saved map of a known scene, and ``query MAP relocalize LOG``."""

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.labels import ROOMS
from semantic_mapper.localization.places import DESCRIPTOR_BYTES, Place
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.query import answer, answer_table, open_saved
from semantic_mapper.queries import instances
from semantic_mapper.queries.objects import ObjectMemory, remember
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.contract.entry_points import serving
from tests.contract.golden import MAP, form, undocumented
from tests.mapping.rendered_views import small_map
from tests.mapping.test_odometry_sessions import INTRINSICS, abroad, even, off, other_world, walk
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import refused, run, run_ok
from tests.queries.house import LABELS, TRUNCATION, VOXEL_M, Box, house_changes, two_rooms
from tests.queries.scene import BALL, BOX, HALF, RADIUS, whole_map


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.npz"
    whole_map().save(path)
    return path


def ask(map_file: Path, *arguments: object) -> tuple[dict, str]:
    words = ("query", map_file, *map(str, arguments))
    return json.loads(run_ok(*words, "--json").stdout), run_ok(*words).stdout


def test_questions_are_answered_in_numbers_and_in_words(map_file: Path, tmp_path: Path) -> None:
    found, shown = ask(map_file, "info")
    assert (found["frames"], found["blocks"], found["label_set"]) == (14, whole_map().block_count, "known")
    assert found["surface_voxels"] == found["without_class"] + sum(found["classes"].values())
    assert "table" in shown and "lamp" not in shown
    found, shown = ask(map_file, "at", *(BOX + np.array([0.0, 0.0, HALF[2]])))  # x is below zero
    assert (found["class"], found["state"]) == ("table", "occupied") and "table" in shown
    found, shown = ask(map_file, "at", *BOX[:2], BOX[2] - 0.08)
    assert (found["class"], found["state"], found["measured"]) == (None, "unknown", None)
    assert 0.05 < found["surface_distance_m"] < 0.3 and [thing["class"] for thing in found["inside"]] == ["table"]
    assert f"inside the box of table {found['inside'][0]['id']}" in " ".join(shown.split())
    found, _ = ask(map_file, "at", "-1e1", "-2", ".5")
    assert (found["class"], found["state"], found["surface_distance_m"]) == (None, "unknown", None)
    found, shown = ask(map_file, "nearest", "cup", *(BALL + np.array([0.0, 0.0, 1.0])))
    assert found["found"] and abs(found["distance_m"] - (1.0 - RADIUS)) < 0.006 and "cup" in shown
    assert ask(map_file, "nearest", "lamp", 0, 0, 0)[0]["found"] is False
    found, shown = ask(map_file, "instances", "--up", "-z")
    large = {thing["class"]: thing for thing in found["instances"] if thing["voxels"] > 200}
    assert set(large) == {"table", "cup"} and "certainty" in shown
    np.testing.assert_allclose(large["table"]["box"]["center"], BOX, atol=0.03)
    assert large["table"]["box"]["R_world_box"][2][2] == -1
    found, shown = ask(map_file, "graph", "--picture", tmp_path / "rooms.png")
    (floor,), (room,) = found["floors"], found["rooms"]
    assert floor["rooms"] == [room["id"]] and room["neighbours"] == found["doors"] == []
    assert {thing["class"] for thing in found["objects"] if thing["room"] == room["id"]} == {"table", "cup"}
    assert "cup" in shown and (tmp_path / "rooms.png").read_bytes().startswith(b"\x89PNG")
    piped = run("query", map_file, "instances").stdout
    assert not set("│┃━─") & set(piped) and " \n" not in piped
    assert answer(open_saved(str(map_file.parent)), "info") == answer(open_saved(str(map_file)), "info")
    assert "blocks" in run_ok("info", map_file.parent).stdout


def test_what_cannot_be_asked_is_said(map_file: Path, tmp_path: Path) -> None:
    picture = tmp_path / "rooms.png"
    for said, words in (
        ("floor, table, cup, lamp", ("query", map_file, "nearest", "kettle", "0", "0", "0")),
        ("row 0", ("query", map_file, "at", "nan", "0", "0")),
        ("no such map file", ("query", tmp_path / "none.npz", "info")),
        ("no floor was found", ("query", map_file, "graph", "--up", "x", "--picture", picture)),
        ("is a map alone; give the folder", ("eval", map_file)),
    ):
        assert said in refused(*words)
    assert "--picture" in refused("query", map_file, "info", "--picture", picture, code=2)
    assert not picture.exists()


def test_instances_of_a_saved_map_stand_as_its_floor_says(tmp_path: Path) -> None:
    plain = whole_map()
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z becomes x
    VoxelMap(plain.config, plain.label_set).merged(plain, T).save(tmp_path / "map.npz")
    found = answer(open_saved(str(tmp_path)), "instances")
    np.testing.assert_allclose(found["up"], (1, 0, 0), atol=0.02)
    assert {thing["class"] for thing in found["instances"] if thing["voxels"] > 200} == {"table", "cup"}


def test_without_a_floor_boxes_stand_along_z(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("semantic_mapper.nodes.cli.query._log", log := Mock())
    walls = [box for box in two_rooms() if box[0] != "floor"]
    snapshot = MapMirror(VOXEL_M, TRUNCATION, LABELS).apply(house_changes(walls, 0))
    assert answer(snapshot, "instances")["up"] == [0, 0, 1]
    assert log.warning.call_args.args == ("boxes_stand_along_z",)


def test_a_running_mapper_answers_as_the_file_does(map_file: Path) -> None:
    with a_folder() as folder, answering(f"ipc://{folder / 'query'}", whole_map()) as service:
        with MapClient(service.endpoint, timeout_s=120) as client:
            client.info()  # once kernels are compiled
        for question, name, point in (
            ("info", "", ()),
            ("at", "", (*BOX[:2], 0.4)),
            ("nearest", "cup", (0.0, 0.0, 1.0)),
            ("nearest", "lamp", (0.0, 0.0, 1.0)),
            ("instances", "", ()),
        ):
            with MapClient(service.endpoint) as client:
                assert answer(client, question, name, point) == answer(open_saved(str(map_file)), question, name, point)
        done = run_ok("query", service.endpoint, "nearest", "cup", "0", "0", "1", "--json")
        assert json.loads(done.stdout)["map"] == service.endpoint
        said = refused("query", service.endpoint, "nearest", "kettle", "0", "0", "0")
        assert "floor, table, cup, lamp" in said


def test_nearest_names_the_thing_that_instances_and_the_graph_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instances, "find_things", find := Mock(wraps=instances.find_things))
    up, seen = (0.0, 0.0, 1.0), []
    with a_folder() as folder, serving(MAP, f"ipc://{folder / 'query'}") as client:
        for world_map in (client, open_saved(str(MAP))):
            listed = answer(world_map, "instances", up=up)["instances"]
            objects = {thing["id"]: thing for thing in answer(world_map, "graph", up=up)["objects"]}
            find.reset_mock()
            for thing in listed:
                seen.append(answer(world_map, "nearest", thing["class"], tuple(thing["centroid"]), up=up))
                near = seen[-1]["thing"]
                assert (
                    near in listed and near["class"] == thing["class"] and near.items() <= objects[near["id"]].items()
                )
            for name, unsure in (("wall", False), ("table", True), ("floor", True)):  # of the table there is a speck
                seen.append(answer(world_map, "nearest", name, up, unsure=unsure))
                assert seen[-1]["found"] and seen[-1]["thing"] is None, name
            assert answer(world_map, "nearest", "table", up)["found"] is False
            assert find.call_count == (world_map is not client), "once a map"
        assert len(seen) >= 14 and seen[: len(seen) // 2] == seen[len(seen) // 2 :]
        assert {t.id for t in client.instances((0.0, 0.5, 1.0))} == {t["id"] for t in listed}, "whatever is up"


def test_changes_since_a_map_of_before(tmp_path: Path) -> None:
    chest: Box = ("table", (0.3, 0.3, 0.0), (0.8, 0.8, 0.4))
    moved: Box = ("table", (4.0, 2.0, 0.0), (4.5, 2.5, 0.4))
    view = Place("front", 5, np.eye(4), np.ones((1, 3), np.float32), np.zeros((1, DESCRIPTOR_BYTES), np.uint8))
    for name, stamp_ns, thing in (("yesterday", 10, chest), ("today", 20, moved)):
        saved = VoxelMap.received(house_changes([*two_rooms(), thing], 0), VOXEL_M, LABELS)
        saved.last_stamp_ns = stamp_ns
        saved.places.add(view)  # both are in one world
        remember(saved)
        saved.save(tmp_path / f"{name}.npz")
    since = ("changes", "--since", tmp_path / "yesterday.npz", "--picture", tmp_path / "changes.png")
    found, shown = ask(tmp_path / "today.npz", *since)
    (change,) = found["changes"]
    assert (found["since_ns"], change["kind"], change["class"], change["before"]["room"]) == (10, "moved", "table", 1)
    np.testing.assert_allclose(change["before"]["box"]["center"], (0.55, 0.55, 0.2), atol=0.08)
    np.testing.assert_allclose(change["now"]["box"]["center"], (4.25, 2.25, 0.2), atol=0.08)
    yesterday = ObjectMemory.from_bytes(VoxelMap.load(tmp_path / "yesterday.npz").objects)
    kept = yesterday.get(change["id"])
    assert kept is not None and "moved" in shown and "room" in shown
    np.testing.assert_allclose(kept.box.center, change["before"]["box"]["center"], atol=1e-4)
    back, _ = ask(tmp_path / "yesterday.npz", "changes", "--since", tmp_path / "today.npz")  # whatever their stamps say
    np.testing.assert_allclose(back["changes"][0]["now"]["box"]["center"], (0.55, 0.55, 0.2), atol=0.08)
    assert [c["kind"] for c in back["changes"]] == ["moved"] and back["since_ns"] < 10
    picture = cv2.cvtColor(cv2.imread(str(tmp_path / "changes.png")), cv2.COLOR_BGR2RGB).astype(int)
    drawn = (
        np.abs(picture - (255, 210, 31)).max(axis=2) < 8
    )  # yellow: a box in each half, and an arrow in the right one
    assert drawn[100:, :780].sum() > 50 and drawn[100:, 820:].sum() > drawn[100:, :780].sum() + 50
    assert "--since MAP" in refused("query", tmp_path / "today.npz", "changes")
    said = refused("query", tmp_path / "today.npz", "info", "--since", tmp_path / "today.npz", code=2)
    assert "goes with `changes`" in said


def test_what_changed_without_a_floor_needs_to_be_told_which_way_is_up(tmp_path: Path) -> None:
    view = Place("front", 5, np.eye(4), np.ones((1, 3), np.float32), np.zeros((1, DESCRIPTOR_BYTES), np.uint8))
    chest: Box = ("table", (0.3, 0.3, 0.0), (0.8, 0.8, 0.4))
    house = [("wall" if name == "floor" else name, low, high) for name, low, high in two_rooms()]
    for name, stamp_ns, boxes in (("yesterday", 10, [*house, chest]), ("today", 20, house)):
        saved = VoxelMap.received(house_changes(boxes, 0), VOXEL_M, LABELS)
        saved.last_stamp_ns = stamp_ns
        saved.places.add(view)
        saved.save(tmp_path / f"{name}.npz")
    changes = ("changes", "--since", tmp_path / "yesterday.npz")
    for question in (changes, ("find", "table")):
        assert "--up says so" in refused("query", tmp_path / "today.npz", *question)
    found, _ = ask(tmp_path / "today.npz", *changes, "--up", "z", "--picture", tmp_path / "changes.png")
    assert [(c["kind"], c["class"]) for c in found["changes"]] == [("gone", "table")]
    assert [a["class"] for a in ask(tmp_path / "today.npz", "find", "table", "--up", "z")[0]["answers"]] == ["table"]


def test_things_are_found_by_a_phrase_with_pictures(tmp_path: Path) -> None:
    saved = VoxelMap.received(house_changes(two_rooms(), 0), VOXEL_M, LABELS)
    remember(saved)
    saved.save(tmp_path / "map.npz")
    phrase = ("find", "table", "on", "the", "floor", "--up", "z")
    found, shown = ask(tmp_path / "map.npz", *phrase, "--pictures", tmp_path / "pictures")
    (answer,) = found["answers"]
    assert undocumented("query", form(found)) == []
    assert (answer["class"], answer["gone_ns"], found["phrase"]) == ("table", None, "table on the floor")
    assert answer["probability"] == pytest.approx(np.prod(list(answer["parts"].values())), abs=1e-3)
    assert Path(answer["picture"]).parent == tmp_path / "pictures" and Path(answer["picture"]).stat().st_size > 300
    assert "look from" in shown and "table on the floor" in shown and "0.0 s" in shown
    assert "nothing in the map fits" in ask(tmp_path / "map.npz", "find", "table on the ceiling", "--up", "z")[1]
    assert "did you mean table" in refused("query", tmp_path / "map.npz", "find", "tabel")
    assert "takes PHRASE" in refused("query", tmp_path / "map.npz", "find", code=2)
    assert "goes with `find`" in refused("query", tmp_path / "map.npz", "info", "--pictures", tmp_path, code=2)


def test_a_map_that_cannot_be_found_again_is_refused_before_the_log_is_read(tmp_path: Path) -> None:
    small_map().save(tmp_path / "map.npz")
    (tmp_path / "bad.mcap").touch()
    assert "has nothing to find oneself by" in refused(
        "query", tmp_path / "map.npz", "relocalize", tmp_path / "bad.mcap"
    )


def test_the_frames_of_a_log_are_found_in_a_map_each_world_by_itself(tmp_path: Path) -> None:
    even().voxel_map.save(tmp_path / "map.npz")
    log_path = tmp_path / "today.mcap"
    with LogWriter(log_path, StreamInfo("today", {"rooms": INTRINSICS}, ROOMS, 4, 15.0)) as log:
        for frame in walk()[1:14:4]:
            log.write_frame(replace(abroad(frame, 0), label=None))
        log.write_frame(replace(walk()[15], world=2, label=None))
        data = log_path.stat().st_size
        log.write_frame(replace(walk()[15], world=2, label=None))
    whole = bytearray(log_path.read_bytes())
    whole[data + 5000] ^= 0xFF
    log_path.write_bytes(bytes(whole))
    found = run("query", tmp_path / "map.npz", "relocalize", log_path, "--json")
    assert found.returncode == 1, found.stderr
    told = json.loads(found.stdout)
    assert (told["frames"], told["found"], told["refused"]) == (5, 5, {})
    assert [frame["number"] for frame in told["unreadable"]] == [5]
    assert [(w["world"], w["agreeing"]) for w in told["sessions"]] == [(0, 4), (2, 1)]
    assert off(np.array(told["sessions"][0]["T_map_world"]) @ other_world(), np.eye(4))[0] < 0.1
    alone = told["sessions"][1]
    assert alone["T_map_world"] is None and alone["disagreement"] == "1 of 3 frames agree on it"


def test_a_thing_that_is_in_no_room_is_listed_and_its_class_explained() -> None:
    thing = {"id": 3, "class": "otherprop", "room": None}
    shown = answer_table({"question": "graph", "map": "m", "floors": [{}], "rooms": [], "objects": [thing]})
    assert [[column.header, *column.cells] for column in shown.columns] == [["room", "none"], ["objects", "otherprop"]]
    assert shown.caption == "otherprop: other object"
