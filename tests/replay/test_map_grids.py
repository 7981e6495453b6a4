"""Training maps of logs: those that teach nothing are left out, with the reason."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.map_grids import make_log_maps, make_room_maps
from semantic_mapper.training.nesf import TrainingMap
from tests.nodes.support import write_log, write_weights
from tests.small import tiny_frames


def test_logs_without_labels_or_depth_are_named(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    blind = write_log(tmp_path / "blind.mcap", [replace(f, depth_m=None) for f in tiny_frames()])
    bare = write_log(tmp_path / "bare.mcap", [replace(f, label=None) for f in tiny_frames()])
    with pytest.raises(ConfigError, match=r"none of 2 logs.*blind.mcap: no labelled frame.*bare.mcap: no labelled"):
        make_log_maps([blind, bare], tmp_path / "maps", weights)
    assert not (tmp_path / "maps").exists()


def test_a_map_that_is_there_is_not_made_again(tmp_path: Path) -> None:
    (tmp_path / "log-a.npz").write_bytes(b"made before")
    assert make_log_maps([tmp_path / "a.mcap"], tmp_path) == [tmp_path / "log-a.npz"]


def test_rooms_become_training_maps(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    path, seldom = make_room_maps([7], tmp_path / "maps", weights, frames=2, rendered=(1, 2))
    found, fewer = TrainingMap.load(path), TrainingMap.load(seldom)
    assert len(fewer.points.xyz) == len(found.points.xyz), "the geometry is of all frames"
    assert 0 < fewer.points.votes.sum() < found.points.votes.sum()
    assert len(found.points.xyz) > 1000 and found.points.log_p.shape[1] == len(ROOMS)
    assert found.row.max() < len(found.points.xyz) and len(np.unique(found.channel)) > 3
    assert len(np.unique(found.instance)) > 3 and (found.instance[found.channel == 0] == 0).all()
    floor = found.row[found.channel == ROOMS.names.index("floor")]
    assert np.abs(np.median(found.points.height_m[floor])) < 0.1
