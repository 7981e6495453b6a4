"""Class evidence as means in 16 bits: the same answers as sums of floats, through all that touches evidence."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.config import VirtualViewConfig, VoxelMapConfig
from semantic_mapper.mapping.files.map_file import describe_map
from semantic_mapper.mapping.files.map_manifest import encode_manifest, parse_manifest
from semantic_mapper.mapping.fusion.evidence import DITHER, PROBABILITY_FLOOR, STEPS_PER_NAT, add_votes_in_turn
from semantic_mapper.mapping.fusion.vote_fusion import add_votes
from semantic_mapper.mapping.views.readout import decide
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.rendered_views import INTRINSICS, LABELS, plane_depth, small_map, sure
from tests.mapping.storage.test_paging import along_the_wall, walk
from tests.mapping.test_voxel_map import same


def after(dtype: type, p: np.ndarray, weights: np.ndarray, cap: float = 255.0, first: int = 0) -> np.ndarray:
    """Mean of log probabilities (L,) that a voxel holds after votes of rows ``p`` in turns."""
    rows = np.resize(p, (len(weights), p.shape[1]))
    if dtype == np.float64:
        return exact_mean(np.log(rows), weights, cap)
    evidence, votes = np.zeros((1, 1, p.shape[1]), dtype), np.zeros((1, 1), np.float32)
    add_votes_in_turn(evidence, votes, np.log(rows).astype(np.float32), weights, cap, DITHER, first)
    assert votes[0, 0] == pytest.approx(min(weights.sum(dtype=np.float64), cap), rel=1e-3)
    return evidence[0, 0] / (STEPS_PER_NAT if dtype == np.int16 else votes[0, 0])


def exact_mean(log_p: np.ndarray, weights: np.ndarray, cap: float) -> np.ndarray:
    """The same in plain numpy and float64: past the cap, old votes fade."""
    total, votes = np.zeros(log_p.shape[1]), 0.0
    for row, weight in zip(log_p, weights.astype(np.float64), strict=True):
        keep = (cap - weight) / votes if votes + weight > cap else 1.0
        total, votes = keep * total + weight * row, min(votes + weight, cap)
    return total / votes


@pytest.mark.parametrize("cap", [255.0, 7.0])
def test_sums_of_floats_are_those_of_plain_numpy(cap: float, rng: np.random.Generator) -> None:
    p = np.maximum(rng.dirichlet(np.full(5, 0.3), 200), PROBABILITY_FLOOR)
    weights = rng.uniform(0.1, 1.0, 200).astype(np.float32)
    np.testing.assert_allclose(after(np.float32, p, weights, cap), after(np.float64, p, weights, cap), rtol=1e-5)


def test_many_votes_too_small_for_a_step_add_up_to_what_they_say() -> None:
    steady = np.array([[0.5, 0.3, 0.2]])
    weights = np.concatenate((np.full(255, 1.0), np.full(40_000, 0.003))).astype(np.float32)
    other = np.concatenate((np.repeat(steady, 255, 0), np.repeat([[0.45, 0.33, 0.22]], 40_000, 0)))
    # One such vote moves the mean by less than half a step, so that plain rounding would never move it.
    assert np.abs(np.log(other[-1] / steady[0])).max() * 0.003 / 255 * STEPS_PER_NAT < 0.01
    exact, ours = after(np.float64, other, weights), after(np.int16, other, weights)
    moved = exact - np.log(steady[0])
    assert np.abs(moved).min() > 0.03
    np.testing.assert_allclose(ours, exact, atol=0.004)


@given(st.integers(0, 2**31 - 1), st.floats(0.05, 1.0), st.integers(1, 2000))
def test_confidence_is_that_of_exact_sums_whatever_the_votes(seed: int, trust: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    p = np.maximum(rng.dirichlet(np.full(5, 0.3), count), PROBABILITY_FLOOR)
    weights = (trust * rng.uniform(0.1, 1.0, count)).astype(np.float32)
    votes = min(float(weights.sum()), 255.0)
    exact, ours = after(np.float64, p, weights), after(np.int16, p, weights, first=seed)
    a, b = decide(exact * votes, votes, 0.75), decide(ours * votes, votes, 0.75)
    assert abs(a[1] - b[1]) < 0.004
    assert a[0] == b[0] or exact[a[0]] - exact[b[0]] < 0.005


def test_the_surest_votes_there_are_never_saturate() -> None:
    p = np.array([[1.0099, PROBABILITY_FLOOR, PROBABILITY_FLOOR]])  # sums to 1 within what is allowed
    ours = after(np.int16, p, np.ones(5000, np.float32))
    np.testing.assert_allclose(ours, np.log(p[0]), atol=1.01 / STEPS_PER_NAT)


@pytest.fixture(scope="module")
def maps() -> dict[str, VoxelMap]:
    made = {
        "float32": small_map(voxel_size_m=0.01),
        "int16": small_map(voxel_size_m=0.01, evidence="int16"),
        "paged": small_map(voxel_size_m=0.01, evidence="int16", memory_mb=10),
    }
    for voxel_map in made.values():
        walk(voxel_map, 12)
        walk(voxel_map, 2)
        add_some_votes(voxel_map)
    return made


def add_some_votes(voxel_map: VoxelMap) -> None:
    pose = along_the_wall(0.2)
    table = sure(1, 0.7).reshape(-1, 3), np.arange(INTRINSICS.width * INTRINSICS.height, dtype=np.int32)
    table = table[0], table[1].reshape(INTRINSICS.height, INTRINSICS.width)
    depth = plane_depth(pose, (0.0, 0.0, 1.0), 1.0)
    assert add_votes(voxel_map, pose, INTRINSICS, depth, table, VirtualViewConfig(max_votes=100.0)) > 0


def agree(a: VoxelMap, b: VoxelMap) -> None:
    """Same surface; same classes and confidence within a hundredth of a per cent or so."""
    ours, theirs = a.points(), b.points()
    np.testing.assert_array_equal(ours.xyz, theirs.xyz)
    assert (ours.label == theirs.label).mean() > 0.999
    np.testing.assert_allclose(ours.confidence, theirs.confidence, atol=0.002)


@pytest.mark.slow
def test_a_map_says_the_same_in_less_memory(maps: dict[str, VoxelMap]) -> None:
    agree(maps["int16"], maps["float32"])
    state = maps["int16"].block_state()
    assert state["evidence"].dtype == np.int16 and np.abs(state["evidence"]).max() > 1000
    per_block = {name: voxel_map._grid.block_bytes for name, voxel_map in maps.items()}
    assert per_block["float32"] - per_block["int16"] == 512 * 2 * len(LABELS)
    a, b = (maps[name].changes(0) for name in ("int16", "float32"))
    assert (a.label == b.label).mean() > 0.999
    assert np.abs(a.confidence.astype(int) - b.confidence).max() <= 1
    a, b = (maps[name].ray_cast(along_the_wall(1.0), INTRINSICS) for name in ("int16", "float32"))
    assert (a.label == b.label).mean() > 0.999 and np.abs(a.confidence - b.confidence).max() < 0.002


def test_paging_saving_and_going_on_give_the_same_bits(maps: dict[str, VoxelMap], tmp_path: Path) -> None:
    assert maps["paged"].stored_blocks > 50
    assert same(maps["paged"].block_state(), maps["int16"].block_state())
    maps["paged"].save(tmp_path / "paged.npz")
    maps["int16"].save(tmp_path / "free.npz")
    maps["float32"].save(tmp_path / "float.npz")
    assert (tmp_path / "free.npz").stat().st_size < (tmp_path / "float.npz").stat().st_size
    assert describe_map(tmp_path / "paged.npz").config.evidence == "int16"
    loaded = VoxelMap.load(tmp_path / "paged.npz")
    assert same(loaded.block_state(), maps["int16"].block_state())
    again = VoxelMap.load(tmp_path / "free.npz")
    for voxel_map in (loaded, again):
        walk(voxel_map, 1, first=5)
    assert same(loaded.block_state(), again.block_state())
    assert not same(loaded.block_state(), maps["int16"].block_state())


@pytest.mark.slow
def test_maps_of_either_kind_merge_into_either(maps: dict[str, VoxelMap]) -> None:
    shift = np.eye(4)
    shift[0, 3] = 0.034  # no whole number of voxels
    sums = maps["float32"].merged(maps["float32"], shift)
    for a, b in (("int16", "float32"), ("float32", "int16"), ("paged", "int16")):
        joined = maps[a].merged(maps[b], shift)
        assert joined.config.evidence == maps[a].config.evidence
        agree(joined, sums)


def test_a_map_file_of_before_is_one_of_floats(tmp_path: Path, maps: dict[str, VoxelMap]) -> None:
    maps["float32"].save(tmp_path / "map.npz")
    plain = msgspec.json.decode(encode_manifest(describe_map(tmp_path / "map.npz")))
    assert plain["config"].pop("evidence") == "float32" and plain["version"] == 2
    assert parse_manifest(msgspec.json.encode(plain), "old").config == maps["float32"].config
    assert VoxelMapConfig().evidence == "float32"
