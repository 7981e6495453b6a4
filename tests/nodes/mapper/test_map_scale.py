"""A running mapper whose stream has no metres says so, in its status, its answers and its files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN
from tests.nodes.mapper.test_live_correction import running_robot, settle, true_poses
from tests.nodes.support import eventually, run_here
from tests.small import tiny_frames

UNKNOWN = {SCALE_KEY: SCALE_UNKNOWN}


def test_a_live_map_without_metres(weights: Path, tmp_path: Path) -> None:
    frames, out = tiny_frames(4), tmp_path / "out"
    with running_robot(weights, out, metadata=UNKNOWN) as robot, MapClient(robot.query, timeout_s=60) as client:
        robot.send(list(frames))
        assert robot.fused(4)
        assert eventually(lambda: client.info().version >= 4) and not client.info().scale_known
        assert any(line.startswith("scale: unknown") for line in robot.status[-1].degraded)
        with pytest.raises(MapError, match="scale is unknown; give a scale"):
            client.nearest("floor", (0, 0, 0))
        with pytest.raises(MapError, match="scale is unknown"):
            client.instances()
        snapshot = client.mirror().snapshot()  # shown and counted all the same
        assert snapshot.block_count > 0
        with pytest.raises(MapError, match="scale is unknown"):
            nearest(snapshot, "floor", (0, 0, 0))
        client.correct_poses(true_poses(frames, 1))
        settle(client)
        assert eventually(lambda: client.info().epoch == 1) and not client.info().scale_known
        assert robot.end(4)["scale"] == SCALE_UNKNOWN
    assert not VoxelMap.load(out / "map.npz").scale_known
    assert b"comment scale: unknown\n" in (out / "map.ply").read_bytes()[:200]


def test_what_the_command_says_of_a_saved_map_without_metres(replayed: Path, tmp_path: Path) -> None:
    voxel_map = VoxelMap.load(replayed / "map.npz")
    voxel_map.note_scale(False)
    saved = tmp_path / "map.npz"
    voxel_map.save(saved)
    code, said = run_here("query", saved, "nearest", "floor", "0", "0", "0")
    assert code == 1 and "scale is unknown; give a scale" in " ".join(said.split())
    code, said = run_here("query", saved, "info", "--json")
    assert code == 0 and json.loads(said)["scale"] == SCALE_UNKNOWN
    code, said = run_here("info", saved)
    assert code == 0 and "units (scale unknown)" in said and " cm" not in said
    code, said = run_here("export", saved, "--out", tmp_path / "plan.yaml")
    assert code == 1 and "scale is unknown" in " ".join(said.split()) and not (tmp_path / "plan.yaml").exists()
    code, said = run_here("merge", saved, replayed, "--out", tmp_path / "both.npz")
    assert code == 1 and "scale of the other is unknown" in " ".join(said.split())
    code, said = run_here("compare", saved, replayed)
    assert code == 2 and "scale of the other is unknown" in " ".join(said.split())
