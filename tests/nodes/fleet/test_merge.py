"""Maps merged into a store of tiles: alignment, resumption, refusals, and that the order of tasks does not matter."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, FleetError, MapError, StoreError
from semantic_mapper.geometry import invert_pose
from semantic_mapper.localization.places import Place
from semantic_mapper.mapping.files.tiles import TILES_NAME, parse_tiles
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.nodes.fleet import merge as merge_module
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.fleet.merge import Alignment, MergeReport, map_names, merge_maps, read_poses, run_on_ray
from semantic_mapper.nodes.fleet.results import ResultFile
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.tile_reading import open_tiles
from semantic_mapper.replay.run_folder import holds_tiles
from semantic_mapper.types import Float64
from tests.mapping.files.test_merge import fuse_views, turned
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import same
from tests.nodes.fleet.made_up import made_up
from tests.nodes.support import run

_R = TypeVar("_R")

EDGE = 4
POSES = {"a": np.eye(4), "b": turned((0, 0, 30), (0.31, -1.27, 0.553)), "c": turned((0, 0, 0), (0.26, -0.06, 0.80))}


def here(function: Callable[..., _R], jobs: Sequence[tuple[Any, ...]], done: Callable[[], None]) -> list[_R]:
    """One task after the other, in this process."""
    return shuffled(None)(function, jobs, done)


def shuffled(seed: int | None) -> Callable[..., Any]:
    """In another order."""

    def run(function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], done: Callable[[], None]) -> list[Any]:
        order = list(range(len(jobs)))
        if seed is not None:
            random.Random(seed).shuffle(order)
        found = {}
        for number in order:
            found[number] = function(*jobs[number])
            done()
        return [found[number] for number in range(len(jobs))]

    return run


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Three robots at a sphere, two of them in worlds of their own."""
    folder = tmp_path_factory.mktemp("maps")
    for number, name in enumerate("abc"):
        (folder / name).mkdir()
        T_world_map = POSES[name]
        voxel_map = fuse_views(
            small_map(voxel_size_m=0.04), range(number * 4, number * 4 + 4), invert_pose(T_world_map)
        )
        voxel_map.save(folder / name / "map.npz")
    return [str(folder / name) for name in "abc"]


def merged(maps: Sequence[str], folder: Path | str, run: Any = here, poses: Any = POSES) -> MergeReport:
    return merge_maps(maps, Store(str(folder), create=True), poses, run, frame_progress, EDGE)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_store_holds_what_merging_one_after_the_other_gives(maps: list[str], tmp_path: Path) -> None:
    report = merged(maps, tmp_path / "store")
    whole = VoxelMap.load(Path(maps[0], "map.npz"))
    for name, url in zip("bc", maps[1:], strict=True):
        whole = whole.merged(VoxelMap.load(Path(url, "map.npz")), POSES[name])
    assert same(open_tiles(str(tmp_path / "store")).load().block_state(), whole.block_state())
    assert [source.placed for source in report.manifest.sources] == ["given"] * 3
    assert [source.name for source in report.manifest.sources] == ["a", "b", "c"]
    assert sorted(os.listdir(tmp_path / "store")) == ["fleet.json", "tiles", "tiles.json"]
    assert report.peak_bytes > 1e7


@pytest.mark.parametrize("seed", [1, 2])
def test_the_order_of_tasks_does_not_matter(maps: list[str], tmp_path: Path, seed: int) -> None:
    merged(maps, tmp_path / "one")
    merged(maps, tmp_path / "other", shuffled(seed))
    assert content(tmp_path / "one") == content(tmp_path / "other")


def test_a_store_that_is_not_local_holds_the_same(maps: list[str], tmp_path: Path) -> None:
    merged(maps, tmp_path / "one")
    url = f"memory://merge-{os.getpid()}-{time.monotonic_ns()}"
    report = merged(maps, url)
    assert report.manifest == parse_tiles((tmp_path / "one" / TILES_NAME).read_bytes(), "one")
    tiled, local = open_tiles(url), open_tiles(str(tmp_path / "one"))
    for point in ((0, 0, 0), (0.4, 0.2, 1.0)):
        found, expected = tiled.nearest("cup", point), local.nearest("cup", point)
        assert found is not None and expected is not None and found.xyz.tolist() == expected.xyz.tolist()
    assert tiled.loads == local.loads > 0
    with pytest.raises(ConfigError, match=r"tiles\.json: is missing"):
        open_tiles("memory://nothing-there")


class InterruptedForTestError(Exception):
    pass


@pytest.mark.parametrize("stop", [1, 4, 6, 9])
def test_an_interrupted_merge_goes_on_and_shows_no_tile_before_its_end(
    maps: list[str], tmp_path: Path, stop: int
) -> None:
    merged(maps, tmp_path / "whole")
    count = 0

    def interrupted(function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], done: Any) -> list[Any]:
        nonlocal count
        found = []
        for job in jobs:
            count += 1
            if count > stop:
                raise InterruptedForTestError
            found.append(function(*job))
        return found

    store = tmp_path / "store"
    with pytest.raises(InterruptedForTestError):
        merged(maps, store, interrupted)
    with pytest.raises(MapError):
        open_tiles(str(store))
    before = {name: (store / name).stat().st_mtime_ns for name in content(store) if name.endswith(".npz")}
    merged(maps, store)
    assert content(store) == content(tmp_path / "whole")
    again = [name for name in before if (store / name).exists() and (store / name).stat().st_mtime_ns != before[name]]
    assert again == [], "tiles that were there are not made again"


def test_pieces_that_are_there_are_not_cut_again(
    maps: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def until_cut(function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], done: Any) -> list[Any]:
        if function is merge_module._fuse:
            raise InterruptedForTestError
        return here(function, jobs, done)

    with pytest.raises(InterruptedForTestError):
        merged(maps, tmp_path, until_cut)

    def never(*_: object) -> None:
        raise AssertionError("cut again")

    monkeypatch.setattr(merge_module, "cut_map", never)
    assert merged(maps, tmp_path).manifest.tiles


def test_a_half_written_tile_of_a_killed_worker_is_replaced(maps: list[str], tmp_path: Path) -> None:
    merged(maps, tmp_path / "whole")
    report = merged(maps, tmp_path / "store")
    (tmp_path / "store" / TILES_NAME).unlink()
    victim = tmp_path / "store" / report.manifest.tiles[0].file
    victim.write_bytes(victim.read_bytes()[:1000])
    merged(maps, tmp_path / "store")
    assert content(tmp_path / "store") == content(tmp_path / "whole")


def test_a_finished_merge_is_not_done_again(maps: list[str], tmp_path: Path) -> None:
    first = merged(maps, tmp_path)
    before = content(tmp_path)
    again = merged(maps, tmp_path)
    assert again.manifest == first.manifest and again.peak_bytes == 0 and content(tmp_path) == before
    with pytest.raises(ConfigError, match=r"has tiles of other maps \(a, b, c\)"):
        merged(maps[:2], tmp_path, poses={name: POSES[name] for name in "ab"})
    assert content(tmp_path) == before


def test_a_lost_tile_is_named_and_made_again(maps: list[str], tmp_path: Path) -> None:
    report = merged(maps, tmp_path)
    before = content(tmp_path)
    lost = tmp_path / report.manifest.tiles[1].file
    lost.unlink()
    with pytest.raises(MapError, match=rf"{lost.name}: this tile is missing; `fleet merge` of the same maps"):
        open_tiles(str(tmp_path)).load()
    again = merged(maps, tmp_path)
    assert again.manifest == report.manifest and content(tmp_path) == before


def test_exchanged_tiles_are_named_and_made_again(maps: list[str], tmp_path: Path) -> None:
    report = merged(maps, tmp_path)
    before = content(tmp_path)
    one, other = (tmp_path / row.file for row in report.manifest.tiles[:2])
    one_bytes = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(one_bytes)
    tiled = open_tiles(str(tmp_path))
    for ask in (tiled.load, tiled.points, tiled.instances):
        with pytest.raises(MapError, match=rf"tiles/({one.name}|{other.name}): is another map"):
            ask()
    again = merged(maps, tmp_path)
    assert again.manifest == report.manifest and content(tmp_path) == before


def test_tiles_are_named_by_their_manifest_as_well(maps: list[str], tmp_path: Path) -> None:
    report = merged(maps, tmp_path)
    assert holds_tiles(str(tmp_path / TILES_NAME))
    assert open_tiles(str(tmp_path / TILES_NAME)).manifest == report.manifest


def test_maps_that_cannot_be_merged_are_refused_before_anything_is_written(maps: list[str], tmp_path: Path) -> None:
    twin = tmp_path / "twin.npz"
    shutil.copy(Path(maps[0], "map.npz"), twin)
    with pytest.raises(MapError, match="a and twin are the same map"):
        merged([*maps, str(twin)], tmp_path / "store")
    with pytest.raises(ConfigError, match="is given twice"):
        merged([maps[0], maps[0]], tmp_path / "store")
    with pytest.raises(ConfigError, match="--poses names d, but the maps are a, b, c"):
        merged(maps, tmp_path / "store", poses={"d": np.eye(4)})
    with pytest.raises(MapError, match="no such map file"):
        merged([*maps, str(tmp_path / "none.npz")], tmp_path / "store")
    assert sorted(os.listdir(tmp_path / "store")) == ["fleet.json"]


def test_an_exchanged_map_of_a_fleet_is_refused(maps: list[str], tmp_path: Path) -> None:
    results = Store(str(tmp_path / "results of a fleet"), create=True)
    made = made_up(0)
    data = Path(maps[0], "map.npz").read_bytes()
    file = ResultFile(len(data), hashlib.sha256(data).hexdigest())
    results.commit(msgspec.structs.replace(made, files={"map.npz": file}))
    results.write(f"{made.folder}/map.npz", Path(maps[1], "map.npz").read_bytes())
    with pytest.raises(StoreError, match="is damaged, or not the file"):
        merged([f"{results.url}/{made.folder}", maps[2]], tmp_path / "store", poses={})


def test_maps_of_the_same_frames_are_refused_by_name(maps: list[str], tmp_path: Path) -> None:
    paths = []
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5, 3)).astype(np.float32)
    place = Place("camera", 5, np.eye(4), points, rng.integers(0, 255, (5, 128), np.uint8))
    for name, url in zip("ab", maps, strict=False):
        voxel_map = VoxelMap.load(Path(url, "map.npz"))
        voxel_map.places.add(place)
        paths.append(str(tmp_path / f"{name}.npz"))
        voxel_map.save(Path(paths[-1]))
    with pytest.raises(MapError, match="a and b were made with the same frames"):
        merged(paths, tmp_path / "store", poses={})


def test_a_map_that_fits_nowhere_is_refused_by_name(maps: list[str], tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"b: where it lies is not known; leave it out.*b beside a: .*nothing to find"):
        merged(maps, tmp_path / "store", poses={"a": np.eye(4), "c": POSES["c"]})
    assert not (tmp_path / "store" / "tiles").exists()


def test_a_map_joins_whichever_placed_map_it_agrees_with_most(maps: list[str], tmp_path: Path) -> None:
    a, b, c = (str(Path(url, "map.npz")) for url in maps)
    T_b_c = turned((0, 0, 0), (1.0, 0.0, 0.0))
    found = {
        (a, b): Alignment(_rows(POSES["b"]), 5, 9),
        (b, c): Alignment(_rows(T_b_c), 4, 9),
    }
    asked: list[tuple[str, str]] = []

    def answered(function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], done: Any) -> list[Any]:
        if function is not merge_module._align:
            return here(function, jobs, done)
        asked.extend((job[1], job[2]) for job in jobs)
        return [found.get((job[1], job[2]), Alignment(None, refusal="too few")) for job in jobs]

    report = merged(maps, tmp_path, answered, poses={})
    assert asked == [(a, b), (a, c), (b, c)], "no pair twice, and none of maps whose places are unknown"
    np.testing.assert_allclose(report.manifest.sources[2].T_world_map, POSES["b"] @ T_b_c)
    assert [source.placed for source in report.manifest.sources] == ["first", "found", "found"]
    assert report.notes[2] == "c: 4 of 9 places found in b"


def test_alignments_of_another_version_are_not_used(maps: list[str], tmp_path: Path) -> None:
    a, b = (str(Path(url, "map.npz")) for url in maps[:2])
    store = Store(str(tmp_path), create=True)
    first = merge_module._align(store.url, a, b, "a" * 64, "b" * 64)
    (name,) = store.names("alignments")
    store.write(f"alignments/{name}", msgspec.json.encode(Alignment(None, refusal="from the store")))
    assert merge_module._align(store.url, a, b, "a" * 64, "b" * 64).refusal == "from the store"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merge_module, "MERGE_VERSION", merge_module.MERGE_VERSION + 1)
        assert merge_module._align(store.url, a, b, "a" * 64, "b" * 64).refusal == first.refusal
    assert len(store.names("alignments")) == 2


def _rows(T: Float64) -> Any:
    return tuple(tuple(row) for row in T.tolist())


def test_poses_are_read_from_text_and_json(tmp_path: Path) -> None:
    path = tmp_path / "poses"
    path.write_text("# name x y z yaw\na 0 0 0 0\n\nb 1 2 3 90  # the east wing\n")
    found = read_poses(path)
    assert list(found) == ["a", "b"]
    np.testing.assert_allclose(found["b"] @ (1, 0, 0, 1), (1, 3, 3, 1), atol=1e-12)
    path.write_text(json.dumps({"a": [1, 2, 3, 90], "b": found["b"].tolist()}))
    again = read_poses(path)
    np.testing.assert_allclose(again["a"], again["b"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a 1 2 3\n", "line 1: write NAME x y z yaw_deg"),
        ("a 1 2 3 east\n", "line 1: write NAME"),
        ("a 1 2 3 0\nb 1 2 3 0\na 4 2 3 0\n", "line 3: a has a pose already"),
        ('{"a": [1, 2, 3]}', r"expected 4 rows of 4 numbers or \[x, y, z, yaw_deg\]"),
        ('{"a": "here"}', "write {NAME"),
        ('{"a": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}', "rigid|rotation"),
        ('{"a": [1, 2, 3, "x"]}', "expected numbers"),
        ('{"a": ', "write {NAME"),
    ],
)
def test_poses_that_are_none_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "poses"
    path.write_text(text)
    with pytest.raises(ValueError, match=says):
        read_poses(path)


def test_maps_are_named_by_their_file_or_folder() -> None:
    assert map_names(["runs/east/map.npz", "runs/west", "s3://maps/attic.npz"]) == ["east", "west", "attic"]
    assert map_names(["1/east.npz", "2/east.npz"]) == ["1/east.npz", "2/east.npz"]


@pytest.mark.slow
def test_maps_find_where_they_lie(seen_maps: tuple[list[str], list[Float64]], tmp_path: Path) -> None:
    paths, worlds = seen_maps
    report = merge_maps(paths, Store(str(tmp_path), create=True), {}, here, frame_progress)
    assert [source.placed for source in report.manifest.sources] == ["first", "found", "found"]
    for source, truth in zip(report.manifest.sources, worlds, strict=True):
        off = invert_pose(truth) @ np.array(source.T_world_map)
        assert np.linalg.norm(off[:3, 3]) < 0.05
    assert len(os.listdir(tmp_path / "alignments")) >= 2


@pytest.mark.slow
def test_workers_of_ray_give_the_same_bytes(maps: list[str], tmp_path: Path) -> None:
    merged(maps, tmp_path / "one")
    with connected("local") as cluster:
        merged(maps, tmp_path / "other", run_on_ray(cluster))
        with pytest.raises(MapError, match="b: where it lies is not known"):
            merged(maps, tmp_path / "third", run_on_ray(cluster, 1), poses={"a": np.eye(4), "c": POSES["c"]})
    assert content(tmp_path / "one") == content(tmp_path / "other")


def _disk_full() -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.slow
def test_an_error_of_a_task_is_reported_with_its_cause(tmp_path: Path) -> None:
    said = r"task 1 of 1 \(disk_full\) failed: OSError: .*No space left"
    with connected("local") as cluster, pytest.raises(FleetError, match=said) as caught:
        run_on_ray(cluster)(_disk_full, [()], lambda: None)
    assert "lost" not in str(caught.value) and "\x1b" not in str(caught.value)
    assert isinstance(caught.value.__cause__, OSError)


KILLED = """
import sys
from tests.nodes.fleet.test_merge import POSES, frame_progress, connected, run_on_ray, merge_maps, Store, EDGE
with connected("local") as cluster:
    merge_maps(sys.argv[2:], Store(sys.argv[1], create=True), POSES, run_on_ray(cluster), frame_progress, EDGE)
"""


@pytest.mark.slow
def test_a_merge_whose_driver_is_killed_goes_on(maps: list[str], tmp_path: Path) -> None:
    merged(maps, tmp_path / "whole")
    store = tmp_path / "store"
    driver = subprocess.Popen([sys.executable, "-c", KILLED, str(store), *maps])
    while driver.poll() is None and not list(store.glob("tiles/*.json")):
        time.sleep(0.02)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    merged(maps, store)
    assert content(store) == content(tmp_path / "whole")


@pytest.mark.slow
def test_the_command_merges_and_query_reads(maps: list[str], tmp_path: Path) -> None:
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({name: T.tolist() for name, T in POSES.items()}))
    store = tmp_path / "store"
    done = run("fleet", "merge", *maps, "--out", store, "--poses", poses, "--tile-blocks", EDGE, "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["maps"]["b"] == POSES["b"].tolist() and said["tiles"] > 1
    done = run("query", store, "info", "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["blocks"] == said["blocks"], done.stderr
