"""``export`` and ``merge``, as commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.exporters.map_files import parse_transform
from semantic_mapper.replay.run_folder import map_path, refuse_overwriting
from tests.mapping.rendered_views import small_map
from tests.mapping.test_formats import read_glb
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import error_line, run


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder such as a replay leaves behind."""
    folder = tmp_path_factory.mktemp("results")
    voxel_map = small_map(voxel_size_m=0.04)
    fuse_sphere(voxel_map, 3)
    voxel_map.save(folder / "map.npz")
    return folder


def test_a_folder_of_results_becomes_a_glb(results: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "sphere.glb"
    done = run("export", results, "--out", out, "--color", "class", "--up", "-y")
    assert done.returncode == 0, done.stderr
    mesh = VoxelMap.load(results / "map.npz").mesh()
    assert f"{out}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces" in done.stdout
    np.testing.assert_array_equal(read_glb(out)[1]["_LABEL"], mesh.label)


def test_what_cannot_be_exported_is_refused_in_one_line(results: Path, tmp_path: Path) -> None:
    done = run("export", results, "--out", results / "map.npz")
    assert done.returncode == 1 and "is the map itself" in error_line(done.stderr)
    VoxelMap.load(results / "map.npz")
    done = run("export", tmp_path, "--out", tmp_path / "a.ply")
    assert done.returncode == 1 and "no map.npz" in error_line(done.stderr)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the same sphere, of one frame more."""
    path = tmp_path_factory.mktemp("other") / "map.npz"
    voxel_map = small_map(voxel_size_m=0.04)
    fuse_sphere(voxel_map, 4)
    voxel_map.save(path)
    return path


def test_two_maps_become_one(results: Path, other: Path, tmp_path: Path) -> None:
    out = tmp_path / "both.npz"
    done = run("merge", results, other, "--transform", "4 0 -0.4 90", "--out", out)
    assert done.returncode == 0, done.stderr
    assert f"{out}: 7 frames" in done.stdout
    one, two, both = (VoxelMap.load(path).points().xyz for path in (results / "map.npz", other, out))
    assert len(both) == len(one) + len(two)
    moved = np.stack((4 - two[:, 1], two[:, 0], two[:, 2] - 0.4), axis=1)  # a quarter turn to the left, then the shift
    second = both[both[:, 0] > 2]
    np.testing.assert_allclose(np.sort(second, axis=0), np.sort(moved, axis=0), atol=1e-5)


def test_merging_says_where_blocks_have_gone(results: Path, other: Path, tmp_path: Path) -> None:
    loaded = [VoxelMap.load(path) for path in (results / "map.npz", other)]
    measured = [int((one.block_state()["weight"] > 0).any(axis=(1, 2, 3)).sum()) for one in loaded]
    counts = [one.block_count for one in loaded]
    assert min(np.subtract(counts, measured)) > 0
    done = run("merge", results, other, "--transform", "0 0 0 0", "--out", tmp_path / "both.npz")
    assert done.returncode == 0, done.stderr
    joined = VoxelMap.load(tmp_path / "both.npz").block_count
    said = " ".join(done.stdout.split())
    assert f"{counts[0]} and {counts[1]} made {joined} blocks; {sum(counts) - sum(measured)} empty blocks" in said


def test_what_cannot_be_merged_is_refused_before_the_maps_are_read(results: Path, other: Path, tmp_path: Path) -> None:
    for arguments, says in (
        (
            (results, results / "map.npz", "--transform", "0 0 0 0"),
            "are the same map: all that it has seen would",
        ),
        ((results, other), "the first one has nothing to find itself by"),
    ):
        done = run("merge", *arguments, "--out", tmp_path / "both.npz")
        assert done.returncode == 1 and says in error_line(done.stderr) and not list(tmp_path.iterdir())


def test_a_transform_is_four_numbers_or_a_file(tmp_path: Path) -> None:
    T = parse_transform("1, 2 3 -90")
    np.testing.assert_allclose(T @ (1, 0, 0, 1), (1, 1, 3, 1), atol=1e-12)
    np.savetxt(tmp_path / "T.txt", T)
    np.testing.assert_array_equal(parse_transform(str(tmp_path / "T.txt")), T)
    np.savetxt(tmp_path / "mirror.txt", np.diag((1, 1, -1, 1)))
    with pytest.raises(PoseError, match="mirror"):
        parse_transform(str(tmp_path / "mirror.txt"))
    np.savetxt(tmp_path / "short.txt", T[:3])
    (tmp_path / "words.txt").write_text("east of here")
    for text, message in (
        ("1 2 3", "four numbers"),
        ("1 2 3 nan", "four numbers"),
        (str(tmp_path / "short.txt"), "4 rows of 4"),
        (str(tmp_path / "words.txt"), "cannot be read"),
        ("nowhere.txt", "nor a file"),
    ):
        with pytest.raises(ConfigError, match=message):
            parse_transform(text)


def test_maps_are_named_by_file_or_folder(results: Path, tmp_path: Path) -> None:
    assert map_path(results) == results / "map.npz" == map_path(results / "map.npz")
    with pytest.raises(ConfigError, match="no map"):
        map_path(tmp_path)
    (tmp_path / "day.mcap").touch()
    with pytest.raises(ConfigError, match=r"day\.mcap: is a log; `semantic-mapper replay .*` makes a map of it"):
        map_path(tmp_path / "day.mcap")
    with pytest.raises(ConfigError, match="the map itself"):
        refuse_overwriting(results / ".." / results.name / "map.npz", tmp_path / "other.npz", results / "map.npz")
