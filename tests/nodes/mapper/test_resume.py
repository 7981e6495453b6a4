"""A restarted mapper: which saved map it goes on from, which it does not, and that it writes over none."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import MapperConfig, VoxelMapConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import CAMVID11, ROOMS
from semantic_mapper.localization.features import Features
from semantic_mapper.localization.places import make_place
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.launcher.liveness import HeartbeatWriter
from semantic_mapper.nodes.mapper.saved_map import continue_map, forbid, keep_earlier, resume_map, stored_settings
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.process import StopRequest
from tests.mapping.test_voxel_map import same
from tests.nodes.mapper.test_live_correction import running_robot
from tests.small import INTRINSICS, tiny_frames

CONFIG = VoxelMapConfig(voxel_size_m=0.05)


def context(folder: Path, restarts: int) -> NodeContext:
    folder.mkdir(exist_ok=True)
    return NodeContext("mapper", {}, 1, StopRequest(), HeartbeatWriter(-1, 1), restarts, folder)


def some_map(frames: int) -> VoxelMap:
    made = VoxelMap(CONFIG, ROOMS)
    for frame in tiny_frames(6)[:frames]:
        made.integrate(frame, frame.depth_m, None)
    return made


def test_map_saved_in_this_launch_is_gone_on_with_as_if_nothing_had_happened(tmp_path: Path) -> None:
    path, folder = tmp_path / "map.npz", tmp_path / "notes"
    some_map(2).save(path)  # by an earlier launch: no map of this one
    before = path.read_bytes()
    assert resume_map(context(folder, 0), path, VoxelMap(CONFIG, ROOMS)) == ""
    resumed = VoxelMap(CONFIG, ROOMS)
    assert "began an empty map: none had been saved" in resume_map(context(folder, 1), path, resumed)
    assert resumed.frames == 0 and path.read_bytes() == before
    some_map(3).save(path)
    said = resume_map(context(folder, 1), path, resumed)
    assert said == "the mapper was restarted and went on from the map saved after 3 frames"
    for frame in tiny_frames(6)[3:]:
        resumed.integrate(frame, frame.depth_m, None)
    assert resumed.frames == 6
    assert same(resumed.block_state(), some_map(6).block_state())


def test_a_run_that_goes_on_keeps_its_settings_but_for_what_the_stored_data_means(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    some_map(2).save(path)
    user = VoxelMapConfig(memory_mb=400, unknown_below=0.3)
    toml = tmp_path / "a.toml"
    toml.write_text("[voxel_map]\nmemory_mb = 400\nunknown_below = 0.3\n")
    settings = stored_settings(MapperConfig(voxel_map=user), toml, 0.0, path).voxel_map
    assert (settings.voxel_size_m, settings.memory_mb, settings.unknown_below) == (0.05, 400, 0.3)
    loaded, fresh = VoxelMap.load(path, config=settings), VoxelMap(settings, ROOMS)
    assert loaded.config == settings
    fresh.take_over(loaded)
    assert same(fresh.block_state(), some_map(2).block_state())
    other = stored_settings(MapperConfig(), None, 0.02, path).voxel_map
    with pytest.raises(ConfigError, match=r"map.npz: was made with voxel_map.voxel_size_m = 0.05 .* 0.02: leave"):
        VoxelMap.load(path, config=other)


def test_a_saved_map_is_gone_on_in_where_it_can_be_found_again(tmp_path: Path) -> None:
    saved, fresh = some_map(3), VoxelMap(CONFIG, ROOMS)
    with pytest.raises(ConfigError, match="nothing to find oneself by"):
        continue_map(fresh, saved, "a.npz")
    found = Features(np.zeros((4, 2)), np.ones(4), np.zeros((4, 128), np.uint8))
    again = some_map(3)
    again.places.add(make_place("c", 1, np.eye(4), found, INTRINSICS))
    fresh = VoxelMap(CONFIG, ROOMS)
    continue_map(fresh, again, "a.npz")
    assert fresh.frames == 3 and len(fresh.places) == 1
    taken_up = some_map(2)
    continue_map(taken_up, again, "a.npz")  # by a restarted mapper, from what it had saved
    assert taken_up.frames == 2
    with pytest.raises(ConfigError, match="go on with the weights"):
        continue_map(VoxelMap(CONFIG, CAMVID11), again, "a.npz")


@pytest.mark.parametrize("case", ["corrected", "damaged", "other settings"])
def test_map_that_cannot_be_gone_on_with_is_put_aside(tmp_path: Path, case: str) -> None:
    path, folder = tmp_path / "map.npz", tmp_path / "notes"
    resume_map(context(folder, 0), path, VoxelMap(CONFIG, ROOMS))
    some_map(3).save(path)
    config, why = CONFIG, ""
    if case == "corrected":
        why = "poses had been corrected"
        forbid(context(folder, 0), why)
    elif case == "damaged":
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    else:
        config, why = VoxelMapConfig(voxel_size_m=0.1), "same config"
    saved = path.read_bytes()
    fresh = VoxelMap(config, ROOMS)
    said = resume_map(context(folder, 1), path, fresh)
    assert "began an empty map" in said and why in said and "map-before-restart-1.npz" in said
    assert fresh.frames == 0 and not path.exists()
    assert (tmp_path / "map-before-restart-1.npz").read_bytes() == saved
    again = VoxelMap(config, ROOMS)
    assert "none had been saved" in resume_map(context(folder, 2), path, again)
    assert (tmp_path / "map-before-restart-1.npz").read_bytes() == saved


def test_results_of_earlier_launches_are_kept_each_in_a_folder(tmp_path: Path) -> None:
    path, contents, results = tmp_path / "map.npz", [], {"map.npz", "summary.json", "map-before-restart-1.npz"}
    for launch in range(3):  # all saved in the same second, by their stamps
        first, second = (context(tmp_path / f"notes-{launch}", restarts) for restarts in range(2))
        resume_map(first, path, VoxelMap(CONFIG, ROOMS))
        keep_earlier(first, path)
        assert not path.exists() and not (tmp_path / "summary.json").exists()
        some_map(launch + 1).save(path)
        os.utime(path, (1.8e9 + launch / 10, 1.8e9 + launch / 10))
        contents.append(path.read_bytes())
        for name in ("summary.json", "map-before-restart-1.npz", "recorded.mcap"):  # the last is the recorder's
            (tmp_path / name).write_text(str(launch))
        assert f"after {launch + 1} frames" in resume_map(second, path, VoxelMap(CONFIG, ROOMS))
        keep_earlier(second, path)
        assert path.read_bytes() == contents[-1], "this launch's own"
    for launch, name in enumerate(("earlier-20270115T080000Z", "earlier-20270115T080000Z-1")):
        assert {p.name for p in (tmp_path / name).iterdir()} == results
        assert (tmp_path / name / "map.npz").read_bytes() == contents[launch]
        assert (tmp_path / name / "summary.json").read_text() == str(launch)


def test_a_live_launch_keeps_earlier_results_a_replay_replaces_them(tmp_path: Path, weights: Path) -> None:
    out, results = tmp_path / "out", {"map.npz", "map.ply", "overview.png", "report.html", "summary.json"}

    def map_a_frame(delivery: str) -> None:
        (notes := tmp_path / "notes").mkdir(exist_ok=True)
        with running_robot(weights, out, 0, context={"folder": notes}, delivery=delivery) as robot:
            robot.send(list(tiny_frames(1)))
            robot.end(1)

    map_a_frame("newest")
    first = (out / "map.npz").read_bytes()
    map_a_frame("newest")
    (kept,) = out.glob("earlier-*")
    assert (kept / "map.npz").read_bytes() == first
    assert {p.name for p in kept.iterdir()} == results == {p.name for p in out.iterdir() if p.is_file()}
    map_a_frame("all")
    assert list(out.glob("earlier-*")) == [kept]
