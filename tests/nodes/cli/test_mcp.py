"""The SDK's own client asks ``semantic-mapper mcp`` over stdin and stdout."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
from mcp import Client, StdioServerParameters, stdio_client

from semantic_mapper.localization.places import DESCRIPTOR_BYTES, Place
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.objects import remember
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import COMMAND, refused
from tests.queries.house import AIR, LABELS, VOXEL_M, Box, house_changes, two_rooms

Calls = list[tuple[str, dict[str, Any]]]


def house(stamp_ns: int, *more: Box) -> VoxelMap:
    boxes = [*two_rooms(), *more]
    made = VoxelMap.received(house_changes(boxes, 0), VOXEL_M, LABELS)
    made.last_stamp_ns = stamp_ns
    view = Place("front", 1, np.eye(4), np.ones((1, 3), np.float32), np.zeros((1, DESCRIPTOR_BYTES), np.uint8))
    made.places.add(view)  # all maps are in one world
    return made


def call(calls: Calls, *arguments: object) -> tuple[list[Any], list[Any]]:
    """The tools there are, and the content of each answer: text of errors, else what it holds."""

    async def ask() -> tuple[list[Any], list[Any]]:
        server = StdioServerParameters(command=str(COMMAND), args=["mcp", *map(str, arguments)])
        async with Client(stdio_client(server)) as client:
            tools = (await client.list_tools()).tools
            found = list[Any]()
            for name, values in calls:
                answer = await client.call_tool(name, values)
                first: Any = answer.content[0]
                known = not answer.is_error and first.type == "text"
                found.append(json.loads(first.text) if known else first)
            return tools, found

    return anyio.run(ask)


def test_an_agent_finds_things_goals_and_pictures_in_a_saved_map(tmp_path: Path) -> None:
    chest: Box = ("table", (0.3, 0.3, 0.0), (0.8, 0.8, 0.4))
    moved: Box = ("table", (4.0, 2.0, 0.0), (4.5, 2.5, 0.4))
    for name, made in (("yesterday", house(10, chest)), ("today", house(20, moved))):
        remember(made)
        made.save(tmp_path / f"{name}.npz")
    calls: Calls = [
        ("describe_room", {}),
        ("describe_room", {"room": "room 2"}),
        ("find", {"phrase": "small table in room 2", "limit": 1}),
        ("goal_near", {"phrase": "big table"}),
        ("what_changed", {}),
        ("look", {"phrase": "table"}),
        ("look", {"eye": [3.6, 1.5, 1.2], "target": [5.0, 0.9, 0.5]}),
        ("look", {"eye": [5.0, 0.9, 2.0], "target": [5.0, 0.9, 0.5]}),
        ("find", {"phrase": "tabel"}),
        ("goal_near", {"phrase": "door"}),
        ("describe_room", {"room": "garage"}),
        ("describe_room", {"room": "²"}),
        ("describe_room", {"room": "9" * 5000}),
        ("look", {"eye": [1.0]}),
    ]
    tools, found = call(calls, tmp_path / "today.npz", "--since", tmp_path / "yesterday.npz")
    assert {tool.name for tool in tools} == {name for name, _ in calls}
    assert all(tool.annotations.read_only_hint and len(tool.description) > 40 for tool in tools)
    rooms, east, small, goal, changes, picture, view, above, *errors = found
    assert [(room["id"], room["counts"]) for room in rooms["rooms"]] == [(2, {"table": 2})]
    np.testing.assert_allclose(sorted(thing["size"][2] for thing in east["things"]), (0.4, 0.7), atol=0.08)
    (answer,) = small["answers"]
    assert {answer["id"], goal["thing"]["id"]} == {thing["id"] for thing in east["things"]}
    np.testing.assert_allclose(answer["box"]["center"], (4.25, 2.25, 0.2), atol=0.08)
    np.testing.assert_allclose(goal["thing"]["box"]["center"], (5.0, 0.9, 0.35), atol=0.08)
    to = np.array(goal["thing"]["box"]["center"])[:2] - goal["position"][:2]
    assert abs(goal["position"][2]) < 0.06 and to @ goal["forward"][:2] > 0.99 * np.linalg.norm(to) > 0.5
    assert [(c["kind"], c["id"]) for c in changes["changes"]] == [("moved", answer["id"])]
    for content in (picture, view, above):
        data = np.frombuffer(base64.b64decode(content.data), np.uint8)
        assert cv2.imdecode(data, cv2.IMREAD_COLOR).shape == (480, 640, 3) and content.mime_type == "image/png"
    said = ("did you mean table", "nothing in the map fits 'door'", *["rooms are 2"] * 3, "eye and target")
    for text, error in zip(said, errors, strict=True):
        assert text in error.text


def test_an_agent_asks_a_running_mapper() -> None:
    with a_folder() as folder, answering(f"ipc://{folder / 'q'}", house(10)) as service:
        calls: Calls = [("find", {"phrase": "table"}), ("find", {"phrase": "table", "limit": 0}), ("what_changed", {})]
        _, (found, none, changes) = call(calls, service.endpoint)
    assert [a["class"] for a in found["answers"]] == ["table"]
    assert "limit is 0" in none.text and "no map of before" in changes.text


def test_a_map_of_one_visit_has_no_changes_and_no_goal_beside_another_thing(tmp_path: Path) -> None:
    largest: Box = ("table", (20.0, 0.0, 0.0), (22.0, 2.0, 0.9))  # and no floor round it
    made = house(10, largest, (AIR, (19.0, -1.0, -0.5), (23.0, 3.0, 2.0)))
    remember(made)
    made.save(tmp_path / "map.npz")
    _, (changes, goal, other) = call(
        [("what_changed", {}), ("goal_near", {"phrase": "largest table"}), ("goal_near", {"phrase": "smallest table"})],
        tmp_path / "map.npz",
    )
    assert "no map of before" in changes.text and "no place from which" in goal.text and other["position"][0] < 7


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    assert "no such file" in refused("mcp", tmp_path / "map.npz")
