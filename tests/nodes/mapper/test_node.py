"""The mapper node's own decisions, and what it says of a map without metres; whole runs are in test_up.py."""

from __future__ import annotations

import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
from structlog.testing import capture_logs

from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.saved_map import resume_map
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN
from tests.nodes.mapper.test_live_correction import running_robot, settle, true_poses
from tests.nodes.mapper.test_resume import context
from tests.nodes.support import eventually
from tests.small import tiny_frames


def test_a_failure_to_write_hides_no_other_one(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mock(side_effect=MapError("map.npz: no space left"))
    monkeypatch.setattr("semantic_mapper.nodes.mapper.node.finish_session", full)
    monkeypatch.setattr("semantic_mapper.replay.session.MapSession.process", full)
    with capture_logs() as logs, running_robot(weights, tmp_path / "out", 0, context={"fails": True}) as robot:
        robot.send(list(tiny_frames(1)))
        robot.node.wait(60)
    assert [log["event"] for log in logs if log["log_level"] == "error"] == ["results_not_written"]


@pytest.mark.parametrize("noted", [True, False])
def test_a_correction_that_cannot_be_noted_ends_only_the_saving(weights: Path, tmp_path: Path, noted: bool) -> None:
    frames, notes, out = tiny_frames(4), tmp_path / "notes", tmp_path / "out"
    notes.mkdir()
    with (
        running_robot(weights, out, context={"folder": notes}, save_every_s=1e-3) as robot,
        MapClient(robot.query, timeout_s=60) as client,
    ):
        robot.send(list(frames))
        assert robot.fused(4)
        if not noted:
            shutil.rmtree(notes)
        client.correct_poses(true_poses(frames, 1))
        assert eventually(lambda: robot.status[-1].counters.get("corrections") == 1)
        warnings = robot.status[-1].degraded
        assert any("no note could say so" in warning for warning in warnings) is not noted
        robot.end(4)
    if noted:  # a mapper that replaced it would begin an empty map
        assert "poses had been corrected" in resume_map(
            context(notes, 1), out / "map.npz", VoxelMap.load(out / "map.npz")
        )


UNKNOWN = {SCALE_KEY: SCALE_UNKNOWN}


def test_a_live_map_without_metres(weights: Path, tmp_path: Path) -> None:
    frames, out = tiny_frames(4), tmp_path / "out"
    with running_robot(weights, out, metadata=UNKNOWN) as robot, MapClient(robot.query, timeout_s=60) as client:
        robot.send(list(frames))
        assert robot.fused(4)
        assert eventually(lambda: client.info().version >= 4) and not client.info().scale_known
        assert any(line.startswith("scale: unknown") for line in robot.status[-1].degraded)
        for ask in (lambda: client.nearest("floor", (0, 0, 0)), client.instances):
            with pytest.raises(MapError, match="scale is unknown"):
                ask()
        assert client.mirror().snapshot().block_count > 0  # shown and counted all the same
        assert [version.state for version in client.weights().versions] == ["in use"]
        client.correct_poses(true_poses(frames, 1))
        settle(client)
        assert eventually(lambda: client.info().epoch == 1) and not client.info().scale_known
        assert robot.end(4)["scale"] == SCALE_UNKNOWN
    assert not VoxelMap.load(out / "map.npz").scale_known
    assert b"comment scale: unknown\n" in (out / "map.ply").read_bytes()[:200]
