"""What a mapper's map remembers is updated beside mapping, and shown where one looks: the chest was moved."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from semantic_mapper.client import MapClient
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.launcher.running import LaunchView
from semantic_mapper.nodes.mapper import live_memory
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.options import FoxgloveOptions
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer.sources import Live, show_live
from semantic_mapper.queries.objects import remember, visit_of
from semantic_mapper.replay.rerun_log import recording_file
from semantic_mapper.transport.messages import Status
from tests.nodes.foxglove.client import FoxgloveClient
from tests.nodes.foxglove.robot import REFRESH_S, WARM_S, bridged_robot
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import eventually, free_port, run_ok
from tests.nodes.viewer.test_sources import logged
from tests.queries.house import LABELS, VOXEL_M, Box, house_changes, two_rooms

MOVED = {"moved": 1, "new": 0, "gone": 0}


def house(x: float, y: float, stamp_ns: int) -> VoxelMap:
    """With a chest at a place."""
    chest: Box = ("table", (x, y, 0.0), (x + 0.5, y + 0.5, 0.4))
    made = VoxelMap(VoxelMapConfig(voxel_size_m=VOXEL_M), LABELS)
    made.add(VoxelMap.received(house_changes([*two_rooms(), chest], 0), VOXEL_M, LABELS), np.eye(4))
    made.last_stamp_ns = stamp_ns
    return made


def gone_on() -> dict[str, Any]:
    """A map that goes on in one of before, and that one."""
    now = house(0.3, 0.3, 10)
    remember(now)
    before = visit_of(now)
    now.take_over(house(4.0, 2.0, 20))
    return {"voxel_map": now, "before": before}


@pytest.fixture
def service() -> Iterator[QueryService]:
    with a_folder() as folder, answering(f"ipc://{folder / 'q'}", **gone_on()) as service:
        yield service


def test_what_was_moved_is_counted_and_told_without_a_question(service: QueryService) -> None:
    assert eventually(lambda: service.status().counters.items() >= MOVED.items(), WARM_S)
    view = LaunchView()
    view.add(Status("mapper", "running", 1, {"restarts": 0, **service.status().counters}))
    assert view.to_json()["nodes"]["mapper"]["changes"] == "1/0/0"
    found = json.loads(run_ok("query", service.endpoint, "graph", "--json").stdout)["remembered"]
    ((changed, still),) = [sorted(found, key=lambda o: o["change"] is None)]
    assert (changed["change"], changed["first_seen_ns"], changed["last_seen_ns"]) == ("moved", 10, 20)
    places = [place["box"]["center"][:2] for place in changed["places"]]
    np.testing.assert_allclose(places, ((0.55, 0.55), (4.25, 2.25)), atol=0.08)
    assert still["change"] is None and len(still["places"]) == 1


def test_answers_are_of_the_last_update_until_it_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_memory, "PAUSE", 1e6)
    monkeypatch.setattr(live_memory, "WANTED_S", 1e6)
    voxel_map = house(0.3, 0.3, 10)
    with a_folder() as folder, answering(f"ipc://{folder / 'q'}", voxel_map) as service:
        assert "moved" not in service.status().counters
        with MapClient(service.endpoint, timeout_s=WARM_S) as client:
            assert {round(a.object.box.center[0]) for a in client.find("table")} == {1, 5}
            version = client.version
            voxel_map.take_over(house(4.0, 2.0, 20))
            assert len(client.find("table", limit=1)) == 1 and client.version == version < voxel_map.version
            assert not client.objects().changes and client.version == version
            np.testing.assert_allclose(client.objects((0.0, 0.0, 1.0)).objects[0].box.R_world_box[:, 2], (0, 0, 1))
            assert client.version == voxel_map.version, "another up is another update"
            with pytest.raises(MapError, match="limit is -1"):
                client.find("table", limit=-1)


def test_a_viewer_and_foxglove_show_what_was_moved(service: QueryService, tmp_path: Path) -> None:
    stop, path = StopRequest(), tmp_path / "live.rrd"
    show = (Live(service.endpoint), lambda: recording_file(path), 0.2, stop, print)
    watcher = threading.Thread(target=show_live, args=show)
    watcher.start()
    assert eventually(lambda: service.status().counters.get("moved") == 1 and service.answered > 4, WARM_S)
    stop.signum = signal.SIGTERM
    watcher.join()
    assert logged(path)["/world/graph/changes"] >= 1 and logged(path)["/world/graph/moves"] >= 1
    port, drawn = free_port(), list[Any]()
    with (
        bridged_robot(FoxgloveOptions(port=port, refresh_s=REFRESH_S)) as robot,
        answering(robot.endpoints["query"], **gone_on()),
        FoxgloveClient(f"ws://127.0.0.1:{port}", {"/graph"}) as client,
    ):

        def step() -> bool:
            robot.publish(2)
            while (message := client.receive(0.05)) is not None:
                drawn[:] = [e for e in SceneUpdate.FromString(message.data).entities if e.id.startswith("change/")]
            return bool(drawn)

        assert eventually(step, WARM_S)
    (entity,) = drawn
    assert entity.texts[0].text.endswith(": moved")
    line = [(p.x, p.y) for p in entity.lines[0].points]
    np.testing.assert_allclose(line, ((0.55, 0.55), (4.25, 2.25)), atol=0.08)


def test_a_map_without_a_frame_says_so_at_once() -> None:
    empty = VoxelMap(VoxelMapConfig(voxel_size_m=VOXEL_M), LABELS)
    with (
        a_folder() as folder,
        answering(f"ipc://{folder / 'q'}", empty) as service,
        MapClient(service.endpoint, timeout_s=WARM_S) as client,
        pytest.raises(MapError, match="not handed its map"),
    ):
        client.find("table")
