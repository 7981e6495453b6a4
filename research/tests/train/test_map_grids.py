"""Training maps of logs: those that teach nothing are left out, with the reason."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from research.evaluation.room_map import UP
from research.train import map_grids
from research.train.map_grids import make_log_maps, make_room_maps
from research.train.nesf import TrainingMap
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.refine import up_frame
from tests.nodes.support import write_log, write_weights
from tests.small import tiny_frames


def test_logs_without_labels_or_depth_are_named(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    blind = write_log(tmp_path / "blind.mcap", [replace(f, depth_m=None) for f in tiny_frames()])
    bare = write_log(tmp_path / "bare.mcap", [replace(f, label=None) for f in tiny_frames()])
    with pytest.raises(ConfigError, match=r"none of 2 logs.*blind.mcap: no labelled frame.*bare.mcap: no labelled"):
        make_log_maps([blind, bare], tmp_path / "maps", weights)
    assert not (tmp_path / "maps").exists()


@pytest.fixture
def upright(monkeypatch: pytest.MonkeyPatch) -> None:
    """Untrained weights find no floor, which says where up is."""
    monkeypatch.setattr(map_grids, "up_frame", lambda voxel_map, up: up_frame(voxel_map, UP))


@pytest.mark.usefixtures("upright")
def test_logs_are_known_by_their_content_and_not_by_their_name(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    for name in ("one", "other", "again"):
        (tmp_path / name).mkdir()
    one = write_log(tmp_path / "one" / "kitchen.mcap", tiny_frames(2))
    other = write_log(tmp_path / "other" / "kitchen.mcap", tiny_frames(3))
    again = Path(shutil.copy(one, tmp_path / "again" / "renamed.mcap"))
    maps, mapped = tmp_path / "maps", []
    paths = make_log_maps([one, other], maps, weights, mapped.append)
    assert len(set(paths)) == 2 and mapped == [one, other]
    written = [path.stat().st_ino for path in paths]
    assert make_log_maps([one, other], maps, weights) == paths
    assert [path.stat().st_ino for path in paths] == written, "nothing is made twice"
    with pytest.raises(ConfigError, match=r"are the same log"):
        make_log_maps([one, again], maps, weights)
    assert make_log_maps([one], tmp_path / "none", weights, stopped=lambda: True) == []
    assert not (tmp_path / "none").exists()


@pytest.mark.usefixtures("upright")
def test_logs_whose_labels_never_reach_their_map_are_left_out(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    names = tuple(f"other {number}" for number in range(len(ROOMS)))
    strange = write_log(tmp_path / "strange.mcap", tiny_frames(2), label_set=replace(ROOMS, names=names))
    with pytest.raises(ConfigError, match=r"strange.mcap: no label of a class"):
        make_log_maps([strange], tmp_path / "maps", weights)


def test_maps_made_of_something_else_are_made_again(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    (path,) = make_room_maps([7], tmp_path, weights, frames=1)
    first = TrainingMap.load(path)
    assert make_room_maps([7], tmp_path, weights, frames=1) == [path]
    replace(first, made_of="other weights", count=first.count * 0).save(path)
    make_room_maps([7], tmp_path, weights, frames=1)
    again = TrainingMap.load(path)
    assert again.made_of == first.made_of and again.count.sum() == first.count.sum() > 0
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(WeightsError, match="delete it, and it is made again"):
        make_room_maps([7], tmp_path, weights, frames=1)


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
