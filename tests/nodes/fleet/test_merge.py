"""Maps of one building fused into one: with given poses, with found ones, and what is refused."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import semantic_mapper
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import ConfigError, MapError, PoseError
from semantic_mapper.geometry import invert_pose, yaw_transform
from semantic_mapper.labels import ROOMS
from semantic_mapper.localization.features import find_place_features
from semantic_mapper.localization.places import Place, make_place
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.fleet import merge
from semantic_mapper.nodes.fleet.merge import MergeReport, find_maps, merge_maps, read_poses
from semantic_mapper.queries.graph import find_graph
from semantic_mapper.queries.objects import ObjectMemory, remember
from semantic_mapper.replay.log.sequence import open_log
from tests.mapping.rendered_views import small_map
from tests.mapping.test_merge import fuse_views, turned
from tests.mapping.test_voxel_map import same
from tests.nodes.fleet.made_up import made_up, store_of
from tests.nodes.support import refused, run_ok
from tests.queries.house import LABELS, VOXEL_M, Box, house_changes, two_rooms

DEMO = Path(semantic_mapper.__file__).parent / "demo.mcap"
POSES = {"a": np.eye(4), "b": turned((0, 0, 30), (0.31, -1.27, 0.553)), "c": turned((0, 0, 0), (0.26, -0.06, 0.80))}


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Three robots at a sphere, two of them in worlds of their own."""
    folder = tmp_path_factory.mktemp("maps")
    for number, (name, T_world_map) in enumerate(POSES.items()):
        views = range(number * 4, number * 4 + 4)
        (folder / name).mkdir()
        fuse_views(small_map(voxel_size_m=0.04), views, invert_pose(T_world_map)).save(folder / name / "map.npz")
    return [str(folder / name) for name in POSES]


def merged(maps: Sequence[str], poses: Any = POSES) -> MergeReport:
    return merge_maps(find_maps(maps), poses)


def test_one_map_holds_what_merging_one_after_the_other_gives(maps: list[str]) -> None:
    report = merged(maps)
    whole = VoxelMap.load(Path(maps[0], "map.npz"))
    for name, folder in zip("bc", maps[1:], strict=True):
        whole = whole.merged(VoxelMap.load(Path(folder, "map.npz")), POSES[name])
    assert same(report.merged.block_state(), whole.block_state())
    assert (report.merged.frames, list(report.poses), report.notes[1]) == (12, ["a", "b", "c"], "b: pose as given")


def test_a_map_that_does_not_fit_in_memory_goes_to_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [str(tmp_path / f"{name}.npz") for name in "ab"]
    for number, path in enumerate(paths):
        fuse_views(small_map(voxel_size_m=0.012), range(number * 6, number * 6 + 6)).save(Path(path))
    poses = {"a": np.eye(4), "b": np.eye(4)}
    whole = merged(paths, poses).merged
    monkeypatch.setattr(merge, "MEMORY_MB", 1)
    spilled = merged(paths, poses).merged
    assert spilled.stored_blocks > 0 == whole.stored_blocks
    assert same(spilled.block_state(), whole.block_state())


def test_the_latest_replays_of_a_store_are_merged(maps: list[str], tmp_path: Path) -> None:
    store = store_of(tmp_path / "store")
    for number, folder in enumerate(maps):
        file = Path(folder, "map.npz")
        changes = {"log": f"/logs/{file.parent.name}.mcap", "log_digest": str(number)}
        result = msgspec.structs.replace(made_up(number), **changes)
        store.upload(file, f"{result.folder}/map.npz")
        store.commit(result)
        key = f"{number:040d}"
        store.commit(msgspec.structs.replace(result, key=key, folder=f"files/{key}/one", finished_ns=1))
    assert same(merged([store.url]).merged.block_state(), merged(maps).merged.block_state())


def test_maps_find_where_they_lie_by_what_they_show(tmp_path: Path) -> None:
    T_map_world = yaw_transform(np.array((2.0, -1.0, 0.3)), 40.0)
    with open_log(DEMO) as log:
        frames = [frame for number, frame in enumerate(log) if number < 24]
    for number, pose in enumerate((np.eye(4), T_map_world)):
        voxel_map = VoxelMap(VoxelMapConfig(voxel_size_m=0.04), ROOMS)
        for frame in frames[number::2]:
            moved = replace(frame, T_world_camera=pose @ frame.T_world_camera)
            voxel_map.integrate(moved, frame.depth_m, None)
            if voxel_map.places.wants(moved.T_world_camera):
                features = find_place_features(frame.rgb, frame.depth_m, 400)
                place = make_place(frame.camera_id, frame.stamp_ns, moved.T_world_camera, features, frame.intrinsics)
                voxel_map.places.add(place)
        voxel_map.save(tmp_path / f"robot-{number}.npz")
    report = merged([str(path) for path in sorted(tmp_path.iterdir())], {})
    off = T_map_world @ report.poses["robot-1"]
    assert np.linalg.norm(off[:3, 3]) < 0.02 and "places found in the maps before it" in report.notes[1]


def test_things_of_merged_maps_are_in_the_rooms_of_the_whole(tmp_path: Path) -> None:
    for name, east_m in (("a", 0.0), ("b", 12.0)):
        boxes: list[Box] = [
            (kind, (a[0] + east_m, a[1], a[2]), (b[0] + east_m, b[1], b[2])) for kind, a, b in two_rooms()
        ]
        made = VoxelMap.received(house_changes(boxes, 0), VOXEL_M, LABELS)
        made.last_stamp_ns = 10
        remember(made)
        made.save(tmp_path / f"{name}.npz")
    report = merged([str(tmp_path / f"{name}.npz") for name in "ab"], dict.fromkeys("ab", np.eye(4)))
    graph = find_graph(report.merged)
    assert graph is not None and len(graph.rooms) == 4
    tables = ObjectMemory.from_bytes(report.merged.objects).there
    rooms = {graph.room_of[t.id] for t in graph.things}
    assert {t.room for t in tables} == rooms == {t.places[-1].room for t in tables} and len(rooms) == len(tables) == 2


def test_maps_that_cannot_be_merged_are_refused(maps: list[str], tmp_path: Path) -> None:
    shutil.copy(Path(maps[0], "map.npz"), tmp_path / "twin.npz")
    place = Place("camera", 5, np.eye(4), np.ones((5, 3), np.float32), np.ones((5, 128), np.uint8))
    for name, folder in zip("ab", maps, strict=False):
        voxel_map = VoxelMap.load(Path(folder, "map.npz"))
        voxel_map.places.add(place)
        voxel_map.save(tmp_path / f"{name}.npz")
    for error, said, given, poses in (
        (MapError, "a and twin are the same map", [*maps, str(tmp_path / "twin.npz")], POSES),
        (MapError, r"cannot be added; .*: b: .*nothing to find", maps, {"a": np.eye(4), "c": POSES["c"]}),
        (MapError, "b: both maps were made with the same frames", [f"{tmp_path}/a.npz", f"{tmp_path}/b.npz"], {}),
        (ConfigError, "--poses names d, but the maps are a, b, c", maps, {"d": np.eye(4)}),
        (ConfigError, "no such map file or folder", [*maps, str(tmp_path / "none.npz")], POSES),
        (ConfigError, "two maps or more; these are: none", [store_of(tmp_path / "store").url], POSES),
    ):
        with pytest.raises(error, match=said):
            merged(given, poses or {name: POSES[name] for name in "ab"})
    path = tmp_path / "poses"
    for error, said, text in (
        (ConfigError, r"a: expected 4 rows of 4 numbers or \[x, y, z, yaw_deg\]", '{"a": [1, 2, 3]}'),
        (ConfigError, "not valid JSON", '{"a": '),
        (PoseError, "", '{"a": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}'),
    ):
        path.write_text(text)
        with pytest.raises(error, match=said):
            read_poses(path)


def test_the_command_merges_and_query_reads(maps: list[str], tmp_path: Path) -> None:
    poses, out = tmp_path / "poses.json", tmp_path / "house.npz"
    poses.write_text(json.dumps({"a": [0, 0, 0, 0], "b": POSES["b"].tolist(), "c": [0.26, -0.06, 0.8, 0]}))
    said = run_ok("merge", *maps, "--out", out, "--poses", poses).stdout
    assert "b: pose as given" in said and "3 maps, 12 frames" in said
    assert "12" in run_ok("query", out, "info").stdout
    assert "the result is made from it" in refused("merge", *maps, "--out", Path(maps[0], "map.npz"), "--poses", poses)
