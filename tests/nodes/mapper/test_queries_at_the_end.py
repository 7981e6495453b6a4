"""A mapper that ends its work still answers questions, about the map that it writes."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest

import semantic_mapper.replay.artifacts
from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import EndOfStream
from tests.mapping.rendered_views import small_map
from tests.mapping.test_correction import drifted, true_poses
from tests.nodes.mapper.test_live_correction import running_robot
from tests.nodes.support import eventually
from tests.queries.scene import LABELS, integrate, poses
from tests.small import tiny_frames


def test_questions_are_answered_while_a_correction_ends_and_while_the_map_is_written(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody has asked before; then somebody asks twice, each time while the mapper does something else."""
    frames = tiny_frames(8)
    about_old, writing, about_new = threading.Event(), threading.Event(), threading.Event()
    advance, finish_session = LiveCorrection._advance, semantic_mapper.replay.artifacts.finish_session

    def wait_and_advance(correction: LiveCorrection, count: int) -> None:
        if correction._ended and not about_old.wait(0.05):
            return
        advance(correction, count)

    def wait_and_finish(*args: Any) -> dict[str, Any]:
        writing.set()
        assert about_new.wait(100)
        return finish_session(*args)

    monkeypatch.setattr(LiveCorrection, "_advance", wait_and_advance)
    monkeypatch.setattr(semantic_mapper.replay.artifacts, "finish_session", wait_and_finish)
    monkeypatch.setattr("semantic_mapper.nodes.mapper.query_service.FIRST_CATCH_UP_S", 5.0)
    monkeypatch.setattr("semantic_mapper.nodes.mapper.query_service.ASKED_LATELY_S", 0.5)
    with running_robot(weights, tmp_path / "out") as robot, MapClient(robot.query, timeout_s=60) as client:
        robot.send(drifted(frames))
        assert robot.fused(8)
        client.correct_poses(true_poses(frames, 1))
        robot.camera.publish(encode(EndOfStream("test", "end", 8)))
        assert eventually(lambda: bool(robot.status) and robot.status[-1].state == "stopping")
        before = client.info()
        assert (before.version, before.epoch) == (8, 0) and before.blocks > 0
        about_old.set()
        assert writing.wait(60)
        time.sleep(0.6)  # so that nobody has asked lately
        after = client.info()
        about_new.set()
        robot.thread.join(100)
        assert (after.version, after.epoch) == (9, 1)
    assert after.blocks == VoxelMap.load(tmp_path / "out" / "map.npz").block_count


def test_who_asks_first_of_a_map_that_is_being_written_is_told_so(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/query"
    voxel_map = small_map(LABELS)
    with QueryService(endpoint, voxel_map) as service, MapClient(endpoint, timeout_s=60) as client:
        assert client.info().blocks == 0
        assert service.hand_over_all(10.0)
    with QueryService(endpoint, voxel_map) as service, MapClient(endpoint, timeout_s=60) as client:
        integrate(voxel_map, poses(1)[0], 0)
        assert not service.hand_over_all(10.0) and not service.asked
        for _ in range(2):
            with pytest.raises(MapError, match="busy, or ending"):
                client.info()
        service.follow()
        assert eventually(lambda: service._mirror.snapshot().version == 1)
        assert client.info().blocks == voxel_map.block_count > 0


def test_who_waits_for_the_first_answer_when_the_mapper_ends_gets_it(tmp_path: Path) -> None:
    voxel_map = small_map(LABELS)
    integrate(voxel_map, poses(1)[0], 0)
    with QueryService(f"ipc://{tmp_path}/query", voxel_map) as service:
        with MapClient(service.endpoint, timeout_s=20, attempts=1) as client:
            answers: list[int] = []
            asking = threading.Thread(target=lambda: answers.append(client.info().blocks))
            asking.start()
            assert eventually(lambda: service.asked, 20) and not service.answered
            assert service.hand_over_all(10.0) and service._mirror.snapshot().version == voxel_map.version
            asking.join(20)
        assert answers == [voxel_map.block_count]
