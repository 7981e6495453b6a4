"""``export`` of maps and ``merge``, as commands."""

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.mapper.test_query_service import a_folder, answering
from tests.nodes.support import refused, run_ok
from tests.queries.scene import whole_map


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
        ("the result is made from it", ("export", results, "--out", results / "map.npz", "--format", "ply")),
        ("no map.npz", ("export", tmp_path, "--out", made.with_suffix(".ply"))),
        ("two maps or more", ("merge", results, "--out", made)),
    ):
        assert said in refused(*words)
    assert "saved maps, which the mapper writes" in refused("export", results, "--out", made, code=2)
    for verb in (("export", results, "--out", made.with_suffix(".ply")), ("query", results, "info"), ("info", results)):
        assert "go with a running mapper" in refused(*verb, "--server", "robot", code=2)
    assert VoxelMap.load(results / "map.npz").frames == 3 and not list(tmp_path.iterdir())


def test_the_map_of_a_running_mapper_is_written_as_its_file_is(tmp_path: Path) -> None:
    whole_map().save(tmp_path / "map.npz")
    with a_folder() as folder, answering(f"ipc://{folder / 'query'}", whole_map()) as service:
        for source, name in ((service.endpoint, "live"), (tmp_path, "saved")):
            run_ok("export", source, "--out", tmp_path / f"{name}.ply")
            assert "cells of 0.05 m" in run_ok("export", source, "--out", tmp_path / f"{name}.yaml").stdout
    read = load_open3d().t.io.read_point_cloud
    live, saved = (read(str(tmp_path / f"{name}.ply")).point["label"].numpy().ravel() for name in ("live", "saved"))
    assert abs(len(live) - len(saved)) < 10
    ids, counts = np.unique(saved, return_counts=True)
    assert [(live == i).sum() for i in ids] == pytest.approx(counts, abs=20)
    assert (tmp_path / "live.pgm").read_bytes() == (tmp_path / "saved.pgm").read_bytes()
