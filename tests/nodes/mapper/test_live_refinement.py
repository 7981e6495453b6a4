"""Saved maps are refined beside a running mapper, in a process of its own that the map never hears of."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.client import MapClient
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, MapError, WeightsError
from semantic_mapper.fields.nesf import save_nesf, smoothed_votes
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.files.map_file import describe_map
from semantic_mapper.mapping.refine import refine
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.autosave import Autosave
from semantic_mapper.nodes.mapper.live_refinement import LiveRefinement
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.options import MapperOptions
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.snapshot import MapSnapshot
from tests.mapping.test_refine import random_weights
from tests.mapping.test_voxel_map import same
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import REPLAY_LAUNCH, Running, eventually
from tests.queries.scene import LABELS, integrate, poses, small_map, whole_map
from tests.queries.test_mirror import assert_same

ALWAYS = 1e-9  # seconds
VIEWS = poses(14)
PATIENCE_S = 120.0  # for a process that imports torch on a busy machine


def refined_in_process(voxel_map: VoxelMap, path: Path) -> MapSnapshot:
    voxel_map.save(path)
    copy = VoxelMap.load(path)
    refine(copy, smoothed_votes(copy.label_set))
    return MapMirror.of(copy).snapshot()


def has_ended(refinement: LiveRefinement) -> bool:
    return refinement._thread is not None and not refinement._thread.is_alive()


def growing_map() -> VoxelMap:
    voxel_map = small_map(LABELS, voxel_size_m=0.03)
    for seq, pose in enumerate(VIEWS[:10]):
        integrate(voxel_map, pose, seq)
    return voxel_map


def test_off_by_default_and_options_that_do_not_go_together_are_refused() -> None:
    assert MapperOptions(out="a").refine_every_s == 0
    with pytest.raises(ConfigError, match="save_every_s"):
        convert_config({"out": "a", "refine_every_s": 5}, MapperOptions, "mapper")
    with pytest.raises(ConfigError, match="goes with refine_every_s"):
        convert_config({"out": "a", "refine_weights": "w"}, MapperOptions, "mapper")


def test_what_was_saved_is_refined_and_the_map_is_as_it_was(tmp_path: Path) -> None:
    voxel_map, path = growing_map(), tmp_path / "map.npz"
    with LiveRefinement(voxel_map, path, ALWAYS, None, idle=False) as refinement:
        autosave = Autosave(voxel_map, path, ALWAYS, refinement.follow)
        integrate(voxel_map, VIEWS[10], 10)
        version, expected = voxel_map.version, refined_in_process(voxel_map, tmp_path / "copy.npz")
        autosave.follow()
        assert eventually(lambda: autosave.saves == 1, 20)
        integrate(voxel_map, VIEWS[11], 11)  # mapping goes on
        assert eventually(lambda: has_ended(refinement), PATIENCE_S)
        assert not refinement.failure and refinement.counters["refinements"] == 1
        found = refinement.mirror.snapshot()
        assert found.version == version < voxel_map.version
        np.testing.assert_array_equal(found.packed, expected.packed)
        for mine, theirs in zip(found.voxels, expected.voxels, strict=True):
            np.testing.assert_array_equal(mine[found.slots], theirs[expected.slots])
        raw = MapMirror.of(VoxelMap.load(path)).snapshot()
        assert (found.voxels.label[found.slots] != raw.voxels.label[raw.slots]).any(), "something was relabelled"
        refined = describe_map(tmp_path / "refined.npz")
        assert (refined.frames, refined.refined) == (11, smoothed_votes(LABELS).digest)
        autosave.close()
        refinement.finish(lambda: None)  # another frame came since
    assert not refinement.degraded and not (tmp_path / "refining").exists()
    control = growing_map()
    for seq in (10, 11):
        integrate(control, VIEWS[seq], seq)
    assert same(voxel_map.block_state(), control.block_state()), "nothing of it has gone back"
    assert not voxel_map.refined


def test_the_map_at_the_end_is_refined_and_only_if_it_has_changed(tmp_path: Path) -> None:
    voxel_map, path = growing_map(), tmp_path / "map.npz"
    voxel_map.save(path)
    with LiveRefinement(voxel_map, path, 1e9, None) as refinement:
        refinement.follow(voxel_map.version, voxel_map.epoch)
        assert refinement._thread is None, "it is not time"
        polls: list[None] = []
        refinement.finish(lambda: polls.append(None))
        assert refinement.counters == {"refinements": 1, "refined_version": voxel_map.version} and polls
        written = (tmp_path / "refined.npz").stat().st_ino
        refinement.finish(lambda: None)
        assert (tmp_path / "refined.npz").stat().st_ino == written


def test_a_crash_is_told_and_the_next_map_is_refined(tmp_path: Path) -> None:
    voxel_map, path = growing_map(), tmp_path / "map.npz"
    voxel_map.save(path)
    with LiveRefinement(voxel_map, path, ALWAYS, None, idle=False) as refinement:
        refinement.follow(voxel_map.version, 0)
        assert eventually(lambda: refinement._process is not None, 20)
        first = refinement._process
        assert first is not None
        refinement.follow(voxel_map.version, 0)
        assert refinement._process is first, "never two at once"
        os.kill(first.pid, signal.SIGKILL)
        assert eventually(lambda: refinement.degraded != (), 20)
        assert refinement.degraded == ("the map was not refined: its process was killed by signal 9",)
        assert refinement.mirror.version == 0 and not (tmp_path / "refined.npz").exists()
        integrate(voxel_map, VIEWS[10], 10)
        assert eventually(lambda: not refinement._thread.is_alive(), 20)  # type: ignore[union-attr]
        voxel_map.save(path)
        refinement.follow(voxel_map.version, 0)
        assert eventually(lambda: has_ended(refinement), PATIENCE_S)
        assert not refinement.failure and refinement.counters["refinements"] == 1
        assert not refinement.degraded and refinement.mirror.version == voxel_map.version


def test_what_cannot_be_refined_says_why(tmp_path: Path) -> None:
    voxel_map, path, weights = growing_map(), tmp_path / "map.npz", tmp_path / "nesf.safetensors"
    save_nesf(random_weights(ROOMS), weights)
    with pytest.raises(WeightsError, match="other classes"):
        LiveRefinement(voxel_map, path, ALWAYS, weights)
    save_nesf(random_weights(LABELS), weights)
    voxel_map.save(path)
    with LiveRefinement(voxel_map, path, ALWAYS, weights, idle=False) as refinement:
        weights.write_bytes(b"no weights")
        refinement.follow(voxel_map.version, 0)
        assert eventually(lambda: str(weights) in refinement.failure, PATIENCE_S), refinement.failure


def test_the_process_ends_with_its_mapper(tmp_path: Path) -> None:
    voxel_map, path = growing_map(), tmp_path / "map.npz"
    voxel_map.save(path)
    with LiveRefinement(voxel_map, path, ALWAYS, None, idle=False) as refinement:
        refinement.follow(voxel_map.version, 0)
        assert eventually(lambda: refinement._process is not None, 20)
        process = refinement._process
        assert process is not None and process.stdin is not None
        process.stdin.close()  # as the end of this process does
        assert eventually(lambda: process.poll() is not None, PATIENCE_S)
        refinement.give_up("the test ends")
    assert refinement.mirror.version == 0


def test_clients_ask_for_the_refined_map_by_a_flag(tmp_path: Path) -> None:
    voxel_map = growing_map()
    local = refined_in_process(voxel_map, tmp_path / "copy.npz")
    refined = MapMirror(local.voxel_size_m, local.truncation_voxels, LABELS)
    with (
        a_folder() as folder,
        QueryService(f"ipc://{folder / 'query'}", voxel_map, refined=refined) as service,
        MapClient(service.endpoint, timeout_s=60, refined=True) as client,
    ):
        with pytest.raises(MapError, match="not been refined yet"):
            client.info()
        refined.apply(local.changes(0))
        assert (client.info().version, client.info().blocks) == (local.version, local.block_count)
        assert_same(client.mirror().snapshot(), local)
        mine, theirs = client.nearest("cup", (1, 1, 1)), nearest(local, "cup", (1, 1, 1))
        assert mine is not None and theirs is not None
        np.testing.assert_array_equal(mine.xyz, theirs.xyz)
        assert mine.confidence == theirs.confidence and client.version == local.version
        assert len(client.instances()) >= 2
        assert not service.asked, "nobody asked for the map itself, and no snapshot of it was made"


def test_a_mapper_that_does_not_refine_says_so() -> None:
    with (
        a_folder() as folder,
        answering(f"ipc://{folder / 'query'}", whole_map()) as service,
        MapClient(service.endpoint, timeout_s=60, refined=True) as client,
        pytest.raises(MapError, match="refine_every_s"),
    ):
        client.at([(0, 0, 0)])


@pytest.mark.slow
def test_a_launch_maps_the_same_with_it(tmp_path: Path, log: Path, weights: Path, config: Path) -> None:
    text = REPLAY_LAUNCH.read_text(encoding="utf-8")
    launch = tmp_path / "refining.toml"
    launch.write_text(text.replace('delivery = "all"\n', 'delivery = "all"\nrefine_every_s = 0.01\n'))
    sets = [
        f"camera.log={log}",
        f"mapper.weights={weights}",
        f"mapper.config={config}",
        "mapper.save_every_s=0.1",
        "mapper.query=",
    ]
    words = [w for s in sets for w in ("--set", s)]
    for name, file in (("with", launch), ("without", REPLAY_LAUNCH)):
        with Running("up", file, *words, "--out", tmp_path / name) as running:
            assert running.wait() == 0, running.text
        if name == "with":
            assert "map_refined" in running.text or "refinement_fails" in running.text
    states = [VoxelMap.load(tmp_path / name / "map.npz").block_state() for name in ("with", "without")]
    assert same(*states)
    assert not (tmp_path / "without" / "refined.npz").exists()
