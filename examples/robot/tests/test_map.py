"""What the robot relies on, asserted on the map of a recorded log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robot import STAND_OFF_M, goal_before

from semantic_mapper.testing import LogReplays, ReplayedMap

FAST = {"voxel_map": {"voxel_size_m": 0.05}, "quality": "fast"}


@pytest.fixture(scope="session")
def room(replay_log: LogReplays, room_log: Path) -> ReplayedMap:
    return replay_log(room_log, config=FAST)


def test_the_room_is_mapped(room: ReplayedMap) -> None:
    assert room.mapped == 12 and not room.refused
    assert room.miou > 0.3 and room.blocks > 100


def test_the_robot_finds_the_floor_and_stops_before_it(room: ReplayedMap) -> None:
    position = (0.0, 0.0, 1.0)
    floor = room.nearest("floor", position)
    assert floor is not None and room.class_at(floor.xyz) == "floor"
    goal = goal_before(floor, position)
    assert np.linalg.norm(goal - floor.xyz) == pytest.approx(STAND_OFF_M)
    assert not room.is_free(floor.xyz)


def test_a_run_that_saw_less_is_told_apart(
    replay_log: LogReplays, room: ReplayedMap, room_log: Path, tmp_path: Path
) -> None:
    room.store(tmp_path)  # a robot's own run is kept: `room.assert_like("runs/room")`, stored by `pytest --update-runs`
    assert room.compare(tmp_path).equal
    half = replay_log(room_log, config=FAST, max_frames=6)
    assert "frames.fused" in [figure.name for figure in half.compare(tmp_path).differences]
