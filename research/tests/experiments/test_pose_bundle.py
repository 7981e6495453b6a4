from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from research.experiments.pose_bundle import Walk, disturb, log_walk, refine, room_walk, visual
from research.scenes import TEST_SEEDS
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.drivers.poses.config import VisualPoses
from semantic_mapper.replay.importers.base import ImportOptions
from semantic_mapper.replay.importers.run import import_recording

pytestmark = pytest.mark.slow


@cache
def walk() -> Walk:
    return room_walk(TEST_SEEDS[0], 80)


def test_disturbed_poses_of_a_room_fit_its_pictures_again() -> None:
    figures = refine(disturb(walk()), PoseRefinerConfig())
    before, after = figures["given"], figures["corrected"]
    assert after["flow_2_px"] < 0.3 * before["flow_2_px"] and after["ate_mm"] < 0.6 * before["ate_mm"]
    assert figures["refined"] > 0.9


def test_a_room_is_followed_within_three_percent_of_the_way() -> None:
    figures = visual(walk(), VisualPoses())
    assert figures["ate_percent_of_path"] < 3 and figures["with_pose"] > 0.6


def test_given_poses_of_a_real_recording_come_nearer_to_its_pictures(redkitchen: Path, tmp_path: Path) -> None:
    log = tmp_path / "kitchen.mcap"
    import_recording(redkitchen, log, options=ImportOptions(max_frames=60))
    figures = refine(log_walk(log, 60), PoseRefinerConfig())
    assert figures["corrected"]["flow_2_px"] < 0.85 * figures["given"]["flow_2_px"]
    assert figures["refined"] > 0.8
