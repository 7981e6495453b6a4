"""What the robot relies on: the map of a recorded log, and its way over a costmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robot import RADIUS_M, plan

from semantic_mapper import OccupancyGrid
from semantic_mapper.testing import LogReplays, ReplayedMap

FAST = {"voxel_map": {"voxel_size_m": 0.05}, "quality": "fast"}
START, GOAL = (0.5, 0.5, 0.0), (2.5, 0.5, 0.0)


@pytest.fixture(scope="session")
def room(replay_log: LogReplays, room_log: Path) -> ReplayedMap:
    return replay_log(room_log, config=FAST)


def test_the_room_is_mapped(room: ReplayedMap) -> None:
    assert room.mapped == 12 and not room.refused
    assert room.miou > 0.3 and room.blocks > 100
    floor = room.nearest("floor", (0.0, 0.0, 1.0))
    assert floor is not None and room.class_at(floor.xyz) == "floor" and not room.is_free(floor.xyz)


def walled(rows: int) -> OccupancyGrid:
    """2 x 3 m of free floor with a wall at x = 1.5 m that leaves a way at its end, or none."""
    cells = np.zeros((40, 60), np.int8)
    cells[:rows, 29:31] = 100
    return OccupancyGrid(cells, 0.05, (0.0, 0.0), np.eye(4)).inflated(RADIUS_M)


def test_the_robot_drives_round_the_wall_over_free_cells() -> None:
    costs = walled(28)
    way = plan(costs, START, GOAL, reach_m=0.3)
    assert (costs.at(way) == 0).all()
    assert (np.abs(np.diff(costs.cells_of(way), axis=0)).max(axis=1) == 1).all(), "from cell to cell"
    assert np.linalg.norm(way[-1] - GOAL) <= 0.35
    round_the_end = 2 * np.hypot(0.9, 1.1)
    assert round_the_end < np.linalg.norm(np.diff(way, axis=0), axis=1).sum() + 0.3 < 1.2 * round_the_end
    assert not len(plan(walled(40), START, GOAL)), "there is no way"


def test_it_leaves_a_start_that_is_too_near_to_the_wall_and_comes_no_nearer() -> None:
    costs = walled(28)
    codes = costs.at(plan(costs, (1.35, 0.5, 0.0), GOAL)).tolist()
    assert codes[:2] == [99, 99] and codes == sorted(codes, reverse=True) and codes.count(99) <= 4
    for start in ((1.5, 0.5, 0.0), (-1.0, 0.5, 0.0)):
        assert not len(plan(costs, start, GOAL)), "in the wall, and where the map is not known"


def test_a_run_that_saw_less_is_told_apart(
    replay_log: LogReplays, room: ReplayedMap, room_log: Path, tmp_path: Path
) -> None:
    room.store(tmp_path)  # a robot's own run is kept: `room.assert_like("runs/room")`, stored by `pytest --update-runs`
    assert room.compare(tmp_path).equal
    half = replay_log(room_log, config=FAST, max_frames=6)
    assert "frames.fused" in [figure.name for figure in half.compare(tmp_path).differences]
