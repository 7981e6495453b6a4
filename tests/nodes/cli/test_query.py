"""The command on a saved map of a known scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import TransportError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.query import answer, open_saved
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import eventually, run, run_here
from tests.queries.scene import BALL, BOX, HALF, RADIUS, whole_map


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.npz"
    whole_map().save(path)
    return path


def ask(map_file: Path, *arguments: object) -> tuple[dict, str]:
    answer = map_file.with_name("answer.json")
    done = run("query", map_file, *map(str, arguments), "--out", answer)
    assert done.returncode == 0, done.stderr
    return json.loads(answer.read_text()), done.stdout


def test_info(map_file: Path) -> None:
    found, shown = ask(map_file, "info")
    assert (found["frames"], found["blocks"], found["label_set"]) == (14, whole_map().block_count, "known")
    assert found["classes"]["floor"] > found["classes"]["table"] > 500 and found["classes"]["lamp"] == 0
    assert found["surface_voxels"] == found["without_class"] + sum(found["classes"].values())
    assert "table" in shown and "lamp" not in shown


def test_a_folder_with_a_map_is_that_map(map_file: Path) -> None:
    folder, file = open_saved(str(map_file.parent)), open_saved(str(map_file))
    assert answer(folder, "info") == answer(file, "info")
    code, said = run_here("info", map_file.parent)
    assert code == 0 and "blocks" in said
    code, said = run_here("query", map_file.parent, "correct", map_file)
    assert code == 1 and "a saved map keeps no frames to correct" in said
    code, said = run_here("eval", map_file)
    assert code == 1 and "is a map alone; give the folder" in said


def test_at_points_below_zero_too(map_file: Path) -> None:
    x, y, z = BOX + np.array([0.0, 0.0, HALF[2]])
    assert x < 0
    found, shown = ask(map_file, "at", x, y, z)
    assert found["class"] == "table" and found["confidence"] > 0.5 and found["surface_distance_m"] < 0.015
    assert found["state"] == "occupied" and "table" in shown
    found, _ = ask(map_file, "at", "-1e1", "-2", ".5")
    assert (found["class"], found["state"], found["surface_distance_m"]) == (None, "unknown", None)


def test_nearest(map_file: Path) -> None:
    above = BALL + np.array([0.0, 0.0, 1.0])
    found, shown = ask(map_file, "nearest", "cup", *above)
    assert found["found"] and abs(found["distance_m"] - (1.0 - RADIUS)) < 0.006
    np.testing.assert_allclose(found["xyz"], BALL + np.array([0.0, 0.0, RADIUS]), atol=0.03)
    assert "cup" in shown
    found, _ = ask(map_file, "nearest", "lamp", *above)
    assert found["found"] is False
    done = run("query", map_file, "nearest", "kettle", "0", "0", "0")
    assert done.returncode == 1 and "floor, table, cup, lamp" in done.stderr.replace("\n", " ")


def test_instances(map_file: Path) -> None:
    found, shown = ask(map_file, "instances", "--up", "0", "0", "-1")
    large = {thing["class"]: thing for thing in found["instances"] if thing["voxels"] > 200}
    assert set(large) == {"table", "cup"}
    np.testing.assert_allclose(large["table"]["box"]["center"], BOX, atol=0.03)
    assert large["table"]["box"]["R_world_box"][2][2] == -1
    assert "table" in shown and str(large["cup"]["voxels"]) in shown


def test_instances_of_a_saved_map_stand_as_its_floor_says(tmp_path: Path) -> None:
    plain = whole_map()
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z becomes x
    VoxelMap(plain.config, plain.label_set).merged(plain, T).save(tmp_path / "map.npz")
    found = answer(open_saved(str(tmp_path)), "instances")
    np.testing.assert_allclose(found["up"], (1, 0, 0), atol=0.02)
    assert {thing["class"] for thing in found["instances"] if thing["voxels"] > 200} == {"table", "cup"}


def answers(endpoint: str) -> bool:
    try:
        with MapClient(endpoint) as client:
            answer(client, "info")
    except TransportError:
        return False
    return True


def test_a_running_mapper_answers_as_the_file_does(map_file: Path) -> None:
    with a_folder() as folder, answering(f"ipc://{folder / 'query'}", whole_map()) as service:
        assert eventually(lambda: answers(service.endpoint), 120), "no answer, not even once kernels are compiled"
        for question, name, point in (
            ("info", "", ()),
            ("at", "", (*BOX[:2], 0.4)),
            ("nearest", "cup", (0.0, 0.0, 1.0)),
            ("nearest", "lamp", (0.0, 0.0, 1.0)),
            ("instances", "", ()),
        ):
            with MapClient(service.endpoint) as client:
                assert answer(client, question, name, point) == answer(open_saved(str(map_file)), question, name, point)
        done = run("query", service.endpoint, "nearest", "cup", "0", "0", "1", "--out", folder / "live.json")
        assert done.returncode == 0 and "cup" in done.stdout, done.stderr
        assert json.loads((folder / "live.json").read_text())["map"] == service.endpoint
        wrong = run("query", service.endpoint, "nearest", "kettle", "0", "0", "0")
        assert wrong.returncode == 1 and "floor, table, cup, lamp" in wrong.stderr.replace("\n", " ")


def test_json_is_printed_alone(map_file: Path) -> None:
    printed = run("query", map_file, "--json", "nearest", "cup", "0", "0", "1")
    assert json.loads(printed.stdout)["class"] == "cup"
    piped = run("query", map_file, "instances").stdout
    assert "table" in piped and not set("│┃━─") & set(piped) and " \n" not in piped


def test_what_cannot_be_asked_is_said(map_file: Path, tmp_path: Path) -> None:
    missing = run("query", tmp_path / "none.npz", "info")
    assert missing.returncode == 1 and "no such map file" in missing.stderr
    nan = run("query", map_file, "at", "nan", "0", "0")
    assert nan.returncode == 1 and "row 0" in nan.stderr


def test_graph_with_a_picture(map_file: Path, tmp_path: Path) -> None:
    found, shown = ask(map_file, "graph", "--picture", tmp_path / "rooms.png")
    (floor,), (room,) = found["floors"], found["rooms"]
    assert (
        floor["rooms"] == [room["id"]] and abs(floor["height_m"]) < 0.02 and room["neighbours"] == found["doors"] == []
    )
    assert {thing["class"] for thing in found["objects"] if thing["room"] == room["id"]} == {"table", "cup"}
    assert "cup" in shown and (tmp_path / "rooms.png").read_bytes().startswith(b"\x89PNG")
    assert run_here("query", map_file, "info", "--picture", "p.png")[0] == 2


def test_a_map_without_a_floor_has_no_picture_of_its_graph(map_file: Path, tmp_path: Path) -> None:
    code, said = run_here("query", map_file, "graph", "--up", "1", "0", "0", "--picture", tmp_path / "rooms.png")
    assert code == 1 and "there is nothing to draw: no floor was found" in said
    assert not (tmp_path / "rooms.png").exists()
