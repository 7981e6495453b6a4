"""Refining maps: what is written reads back, tiles join, and what cannot be refined is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import MapError, WeightsError
from semantic_mapper.fields.nesf import Nesf, NesfConfig, NesfWeights, smoothed_votes
from semantic_mapper.labels import NYU40, ROOMS, LabelSet, make_label_set
from semantic_mapper.mapping.fusion import EVIDENCE_STEPS
from semantic_mapper.mapping.refine import FILL_VOTES, check_refinable, refine
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.grids import decided
from tests.small import tiny_frames

UP = np.array((0.0, 0.0, 1.0))


def make_map(label_set: LabelSet = ROOMS, votes: bool = True, **changes: object) -> VoxelMap:
    """A small room; each second row of pixels votes, with chance probabilities of the true class."""
    config = replace(VoxelMapConfig(voxel_size_m=0.04, unknown_below=0.0), **changes)
    voxel_map = VoxelMap(config, label_set)
    rng = np.random.default_rng(0)
    for frame in tiny_frames():
        said = rng.dirichlet(np.full(len(label_set), 0.3), frame.label.shape).astype(np.float32)
        known = np.zeros(frame.label.shape, np.bool_)
        known[: frame.label.shape[0] // 2] = votes
        voxel_map.integrate(frame, frame.depth_m, said if votes else None, known if votes else None)
    return voxel_map


def random_weights(label_set: LabelSet = ROOMS, spread: float = 0.5) -> NesfWeights:
    """A network whose answers are no zeros."""
    torch.manual_seed(0)
    model = Nesf(label_set, NesfConfig(width=2)).eval()
    torch.nn.init.normal_(model.net.head.weight, std=spread)
    return NesfWeights(model, {}, "ab" * 32)


def test_geometry_and_colour_stay_bit_for_bit_and_evidence_does_not() -> None:
    voxel_map = make_map()
    before = voxel_map.block_state()
    report = refine(voxel_map, random_weights(), up=UP)
    after = voxel_map.block_state()
    for name in ("keys", "tsdf", "weight", "color"):
        np.testing.assert_array_equal(before[name], after[name])
    assert (before["evidence"] != after["evidence"]).any()
    voted = before["votes"] > 0
    np.testing.assert_array_equal(before["votes"][voted], after["votes"][voted])
    assert report.relabelled > 100


@pytest.mark.parametrize("fill", [0.2, 1.0])
def test_only_likely_classes_fill_surface_without_votes(fill: float) -> None:
    voxel_map = make_map()
    before = voxel_map.block_state()
    report = refine(voxel_map, random_weights(spread=5.0), up=UP, fill=fill)
    after = voxel_map.block_state()
    filled = (before["votes"] == 0) & (after["votes"] > 0)
    assert (report.filled > 100) == filled.any() == (fill < 1)
    assert (after["votes"][filled] == np.float32(FILL_VOTES)).all()
    for row in after["evidence"][filled][::50]:
        assert decided(row, FILL_VOTES, 0.75)[1] >= fill - 1e-4


def test_tiles_give_what_the_whole_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, tiled = make_map(), make_map()
    refine(whole, random_weights(), up=UP)
    monkeypatch.setattr("semantic_mapper.mapping.refine.TILE_M", 1.5)
    seen: list[int] = []
    refine(tiled, random_weights(), up=UP, on_tile=lambda done, total: seen.append(total))
    assert seen[0] > 2
    a, b = whole.block_state(), tiled.block_state()
    np.testing.assert_array_equal(a["votes"], b["votes"])
    np.testing.assert_allclose(a["evidence"].astype(float), b["evidence"], atol=4)


def test_the_file_says_by_what_it_was_refined_and_other_files_say_nothing(tmp_path: Path) -> None:
    voxel_map = make_map()
    voxel_map.save(tmp_path / "plain.npz")
    assert b"refined" not in (tmp_path / "plain.npz").read_bytes()
    refine(voxel_map, random_weights(), up=UP)
    voxel_map.save(tmp_path / "refined.npz")
    again = VoxelMap.load(tmp_path / "refined.npz")
    assert again.refined == "ab" * 32
    with pytest.raises(MapError, match=r"refined already \(weights of digest abababababab"):
        refine(again, random_weights(), up=UP)
    smoothed = make_map()
    refine(smoothed, smoothed_votes(ROOMS), up=UP, fill=0.0)
    with pytest.raises(MapError, match="its votes were smoothed"):
        refine(smoothed, random_weights(), up=UP)


def test_what_cannot_be_refined_is_refused() -> None:
    unknown = make_map()
    unknown.note_scale(False)
    empty = VoxelMap(VoxelMapConfig(), ROOMS)
    for voxel_map, why in ((empty, "empty"), (make_map(voxel_size_m=0.08), "too coarse"), (unknown, "not metres")):
        with pytest.raises(MapError, match=why):
            check_refinable(voxel_map)
    with pytest.raises(WeightsError, match=r"'rooms'.*'nyu40'.*--by-name"):
        refine(make_map(), random_weights(NYU40), up=UP)
    with pytest.raises(WeightsError, match="no class alike"):
        refine(make_map(), random_weights(make_label_set("other", ["a", "b"])), up=UP, by_name=True)


def test_by_name_leaves_the_probability_of_other_classes_alone() -> None:
    voxel_map = make_map()
    before = voxel_map.block_state()
    known = make_label_set("few", ["wall", "floor", "lamp"])
    refine(voxel_map, random_weights(known), up=UP, by_name=True)
    after = voxel_map.block_state()
    assert voxel_map.label_set == ROOMS
    changed = (before["votes"] > 0) & (before["evidence"] != after["evidence"]).any(axis=-1)
    votes = before["votes"][changed][:, None].astype(np.float64)
    worth = np.where(votes > 1, votes / (1 + 0.75 * (votes - 1)), 1)

    def read(state: dict) -> np.ndarray:
        e = np.exp(state["evidence"][changed] * worth / -EVIDENCE_STEPS)
        return e / e.sum(axis=1, keepdims=True)

    p, q = read(before), read(after)
    assert len(p) > 100
    np.testing.assert_allclose(p[:, 2:], q[:, 2:], atol=3e-4)
    assert np.abs(p[:, :2] - q[:, :2]).max() > 0.05
