"""``export`` and ``merge``, as commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.exporters.map_files import parse_transform
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import refused, run_ok


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder such as a replay leaves behind, and a map of the same sphere, of one frame more."""
    folder = tmp_path_factory.mktemp("results")
    for name, frames in (("map", 3), ("other", 4)):
        voxel_map = small_map(voxel_size_m=0.04)
        fuse_sphere(voxel_map, frames)
        voxel_map.save(folder / f"{name}.npz")
    return folder


def test_two_maps_become_one(results: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "both.npz", results / "other.npz"
    said = run_ok("merge", results, other, "--transform", "4 0 -0.4 90", "--out", out).stdout
    assert f"{out}: 7 frames" in said
    one, two, both = (VoxelMap.load(path).points().xyz for path in (results / "map.npz", other, out))
    assert len(both) == len(one) + len(two)
    moved = np.stack((4 - two[:, 1], two[:, 0], two[:, 2] - 0.4), axis=1)  # a quarter turn to the left, then the shift
    second = both[both[:, 0] > 2]
    np.testing.assert_allclose(np.sort(second, axis=0), np.sort(moved, axis=0), atol=1e-5)


def test_what_cannot_be_exported_or_merged_is_refused_and_leaves_nothing(results: Path, tmp_path: Path) -> None:
    made = tmp_path / "a.npz"
    for said, words in (
        ("the result is made from it", ("export", results, "--out", results / "map.npz")),
        ("no map.npz", ("export", tmp_path, "--out", made.with_suffix(".ply"))),
        ("are the same map", ("merge", results, results / "map.npz", "--transform", "0 0 0 0", "--out", made)),
        ("has nothing to find itself by", ("merge", results, results / "other.npz", "--out", made)),
    ):
        assert said in refused(*words)
    assert VoxelMap.load(results / "map.npz").frames == 3 and not list(tmp_path.iterdir())


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
    for text in ("1 2 3", "1 2 3 nan", str(tmp_path / "short.txt"), str(tmp_path / "words.txt"), "nowhere.txt"):
        with pytest.raises(ConfigError):
            parse_transform(text)
