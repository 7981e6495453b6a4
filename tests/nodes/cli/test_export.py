"""``export`` of maps and ``merge``, as commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import refused


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder such as a replay leaves behind."""
    folder, voxel_map = tmp_path_factory.mktemp("results"), small_map(voxel_size_m=0.04)
    fuse_sphere(voxel_map, 3)
    voxel_map.save(folder / "map.npz")
    return folder


def test_what_cannot_be_exported_or_merged_is_refused_and_leaves_nothing(results: Path, tmp_path: Path) -> None:
    made = tmp_path / "a.npz"
    for said, words in (
        ("the result is made from it", ("export", results, "--out", results / "map.npz")),
        ("no map.npz", ("export", tmp_path, "--out", made.with_suffix(".ply"))),
        ("two maps or more", ("merge", results, "--out", made)),
    ):
        assert said in refused(*words)
    assert VoxelMap.load(results / "map.npz").frames == 3 and not list(tmp_path.iterdir())
