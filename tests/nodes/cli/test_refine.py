"""``refine``, as a command."""

import json
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.fields.nesf import DEFAULT, load_nesf, save_nesf
from semantic_mapper.labels import NYU40
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.test_refine import make_map, random_weights
from tests.nodes.support import refused, run_ok, write_weights


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with map.npz, weights that fit it, and some that do not."""
    folder = tmp_path_factory.mktemp("refine")
    make_map().save(folder / "map.npz")
    save_nesf(random_weights(), folder / "nesf.safetensors")
    save_nesf(random_weights(NYU40), folder / "nyu40.safetensors")
    write_weights(folder / "field.safetensors")
    return folder


def test_a_refined_map_is_a_map_like_any_other(files: Path, tmp_path: Path) -> None:
    out, weights = tmp_path / "new" / "refined.npz", files / "nesf.safetensors"
    said = run_ok("refine", files, "--weights", weights, "--up", "z", "--out", out).stdout
    assert "of the surface relabelled" in said and "by the weights" in said
    before, after = VoxelMap.load(files / "map.npz"), VoxelMap.load(out)
    assert after.refined == load_nesf(weights).digest
    np.testing.assert_array_equal(before.block_state()["tsdf"], after.block_state()["tsdf"])
    assert (before.points().label != after.points().label).any()
    run_ok("query", out, "info", "--json")
    done = run_ok("refine", files, "--weights", weights, "--up", "z", "--out", out, "--fill", "1", "--json")
    found = json.loads(done.stdout)
    assert found["filled"] == 0 and found["relabelled"] > 0
    assert sum(found["before"].values()) == sum(found["after"].values()) == found["surface"]
    run_ok("refine", files, "--up", "z", "--out", out)
    assert VoxelMap.load(out).refined == load_nesf(DEFAULT).digest


def test_maps_of_other_classes_than_the_weights_that_ship_are_smoothed(tmp_path: Path) -> None:
    make_map(NYU40).save(tmp_path / "map.npz")
    done = run_ok("refine", tmp_path / "map.npz", "--up", "z", "--out", tmp_path / "smooth.npz")
    assert "the votes were smoothed, nothing was learned" in done.stdout
    before, after = (VoxelMap.load(tmp_path / name).mesh() for name in ("map.npz", "smooth.npz"))
    ends = before.faces[:, :2]
    borders = [(mesh.label[ends[:, 0]] != mesh.label[ends[:, 1]]).mean() for mesh in (before, after)]
    assert borders[1] < 0.8 * borders[0], "chance votes become patches"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("map.npz --out map.npz", "the result is made from it"),
        ("missing.npz --out out.npz", "no such map"),
        ("nesf.safetensors --out out.npz", "not a map"),
        ("map.npz --out out.npz --weights field.safetensors", "weights of kind 'sray'"),
        ("map.npz --out out.npz --weights nyu40.safetensors --up z", "--by-name"),
        ("map.npz --out out.npz --weights nesf.safetensors --up sideways", "--up sideways"),
    ],
)
def test_bad_input_is_refused_and_nothing_is_written(files: Path, words: str, said: str) -> None:
    assert said in refused("refine", *(files / word if "." in word else word for word in words.split()))
    assert not (files / "out.npz").exists()
