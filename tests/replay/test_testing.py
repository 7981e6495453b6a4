"""The pytest plugin: replays in process, questions to their maps, stored runs, and that it costs nothing before."""

import json
import os
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, LabelError, LogError, MapError
from semantic_mapper.labels import ROOMS
from semantic_mapper.queries.nearest import at
from semantic_mapper.queries.occupancy import State, occupancy
from semantic_mapper.replay.testing import LogReplays, ReplayedMap
from tests.nodes.support import CONFIG, write_config, write_log, write_weights
from tests.small import tiny_frames

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a robot project: a log, weights, settings."""
    folder = tmp_path_factory.mktemp("project")
    write_log(folder / "room.mcap", tiny_frames())
    write_weights(folder / "tiny.safetensors")
    write_config(folder / "mapper.toml")
    return folder


def replays(root: Path, made: Path, **options: bool) -> LogReplays:
    folders = iter(range(100))
    return LogReplays(root, lambda name: made / f"{name}-{next(folders)}", **options)


@pytest.fixture(scope="module")
def room(root: Path, tmp_path_factory: pytest.TempPathFactory) -> ReplayedMap:
    made = replays(root, tmp_path_factory.mktemp("replays"))
    return made("room.mcap", weights="tiny.safetensors", config="mapper.toml")


def test_questions_are_answered_as_the_queries_answer_them(room: ReplayedMap) -> None:
    told = json.loads((room.folder / "summary.json").read_text())
    assert (room.miou, room.map_miou) == (told["metrics"]["miou"], told["metrics"]["map_miou"])
    assert (room.mapped, room.blocks, room.refused) == (6, told["map"]["blocks"], [])
    points = room.voxel_map.points()
    answers = at(room.snapshot, points.xyz[::50])
    names = dict(zip(ROOMS.ids, ROOMS.names, strict=True))
    said = [room.class_at(p) for p in points.xyz[::50]]
    assert said == [names.get(int(i)) for i in answers.label] and len(set(said)) > 1
    assert room.class_at((90.0, 0.0, 0.0)) is None
    wall = room.nearest("wall", (0.0, 0.0, 1.0))
    if wall is not None:
        assert room.class_at(wall.xyz) == "wall"
    around = points.xyz[::50] + np.random.default_rng(0).normal(0, 0.2, (len(points.xyz[::50]), 3))
    states = occupancy(room.snapshot, around)
    assert [room.is_free(p) for p in around] == [s == State.FREE for s in states] and len(set(states)) == 3
    with pytest.raises(LabelError, match="spaceship"):
        room.nearest("spaceship", (0, 0, 0))
    with pytest.raises(MapError, match="expected shape"):
        room.class_at((1.0, 2.0))


def test_a_replay_is_done_once_for_the_same_settings(root: Path, tmp_path: Path) -> None:
    replay_log = replays(root, tmp_path)
    sections = {name: section for name, section in tomllib.loads(CONFIG).items() if name != "sampling"}
    first = replay_log("room.mcap", weights="tiny.safetensors", config=sections, max_frames=2)
    assert replay_log(root / "room.mcap", weights=root / "tiny.safetensors", config=sections, max_frames=2) is first
    other = replay_log("room.mcap", weights="tiny.safetensors", config=sections, quality="fast", max_frames=2)
    assert other is not first and other.summary["quality"] == "fast" and first.mapped == other.mapped == 2


def test_refused_frames_are_told_and_a_log_of_nothing_else_is_an_error(root: Path, tmp_path: Path) -> None:
    frames = [replace(f, label=None) for f in tiny_frames(3)]
    lost = [replace(f, T_world_camera=2 * f.T_world_camera) for f in frames]
    write_log(tmp_path / "some.mcap", [lost[0], *frames[1:]])
    write_log(tmp_path / "none.mcap", lost)
    replay_log, settings = replays(root, tmp_path), {"weights": "tiny.safetensors", "config": "mapper.toml"}
    some = replay_log(tmp_path / "some.mcap", **settings)
    assert some.mapped == 2 and len(some.refused) == 1 and "seq=0" in some.refused[0]
    with pytest.raises(LogError, match="nothing to score"):
        _ = some.miou
    with pytest.raises(LogError, match="frames could be mapped"):
        replay_log(tmp_path / "none.mcap", **settings)
    with pytest.raises(LogError, match=r"gone\.mcap"):
        replay_log("gone.mcap", **settings)
    with pytest.raises(ConfigError, match="did you mean `voxel_map`"):
        replay_log("room.mcap", config={"voxel_maps": {}})


def test_a_stored_run_is_compared_with_tolerances(room: ReplayedMap, root: Path, tmp_path: Path) -> None:
    room.store(tmp_path / "stored")
    assert sorted(p.name for p in (tmp_path / "stored").iterdir()) == ["map.npz", "summary.json"]
    room.assert_like(tmp_path / "stored")
    fewer = replays(root, tmp_path)("room.mcap", weights="tiny.safetensors", config="mapper.toml", max_frames=5)
    with pytest.raises(AssertionError, match=r"frames\.fused: 6 and 5, 1 apart, allowed 0"):
        fewer.assert_like(tmp_path / "stored")
    with pytest.raises(ConfigError, match="did you mean `labels`"):
        fewer.assert_like(tmp_path / "stored", label=0.1)
    with pytest.raises(AssertionError, match=r"no run is stored at .*--update-runs"):
        room.assert_like("nowhere")


def test_the_plugin_costs_nothing_until_it_is_used() -> None:
    program = (
        "import sys, semantic_mapper.testing\n"
        "heavy = {'numpy', 'torch', 'open3d', 'scipy', 'cv2', 'zmq', 'msgspec', 'structlog'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.returncode) == ("[]", 0), done.stderr
