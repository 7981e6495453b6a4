"""Training the network that refines maps: a map with wrong votes is put right from labels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from research.train.map_grids import training_map
from research.train.nesf import NesfTrainConfig, TrainingMap, VoxelLabels, _crop, train_nesf
from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.nesf import (
    CELL_M,
    FARTHEST_M,
    NesfConfig,
    find_nesf,
    load_nesf,
    pool,
    save_nesf,
)
from semantic_mapper.labels import ROOMS, make_label_set
from tests.mapping.test_refine import UP, make_map
from tests.small import tiny_frames

TINY = NesfTrainConfig(
    steps=60,
    field=NesfConfig(width=4),
    labelled_voxels=2000,
    validate_every=60,
    learning_rate=1e-2,
)


@pytest.fixture(scope="module")
def noisy() -> TrainingMap:
    """A map whose votes are chance."""
    return training_map(make_map(), tiny_frames(), ROOMS, UP)


def test_hits_lie_on_the_surface_and_have_the_class_of_their_pixels(noisy: TrainingMap) -> None:
    pixels = sum(int((f.label > 0).sum()) for f in tiny_frames())
    assert 0.5 * pixels < noisy.count.sum() <= pixels
    floor = noisy.channel == ROOMS.names.index("floor")
    assert floor.sum() > 50
    assert np.median(np.abs(noisy.points.height_m[noisy.row[floor]])) < 0.05
    assert np.median(noisy.points.rise[noisy.row[floor]]) > 0.9


def test_a_voxel_has_the_class_of_most_pixels_whatever_their_objects(noisy: TrainingMap) -> None:
    columns = np.array([(0, 4, 1, 3), (0, 4, 2, 3), (0, 5, 3, 5), (2, 1, 0, 1), (2, 4, 9, 1), (2, 4, 8, 2)])
    row, channel, instance, count = columns.T
    found = dataclasses.replace(noisy, row=row, channel=channel, instance=instance, count=count.astype(np.float32))
    voxels = found.voxels
    assert voxels.row.tolist() == [0, 2] and voxels.channel.tolist() == [4, 4]
    assert (voxels.thing >= 0).all() and len(np.unique(voxels.thing)) == 2
    none = dataclasses.replace(found, row=row[:0], channel=channel[:0], instance=instance[:0], count=found.count[:0])
    assert len(none.voxels.row) == 0


def test_labels_of_images_teach_the_network(noisy: TrainingMap) -> None:
    trained = train_nesf(TINY, ROOMS, [noisy], [noisy])
    found = trained.recipe["validation"]
    assert found["miou"] > 1.5 * found["map_miou"]
    assert found["loss"] < 0.8 * trained.recipe["history"][0]["loss"]
    assert trained.recipe["history"][0]["step"] == 0
    assert 0.4 < float(trained.model.temperature) < 3.1


def test_a_network_that_overrules_right_votes_is_trusted_less(noisy: TrainingMap) -> None:
    """It learns wrong labels, and is validated on a map of which the votes are right."""
    rows, channel, _ = noisy.voxels
    right = noisy.points.log_p.copy()
    right[rows] = np.log(0.01)
    right[rows, channel] = np.log(0.8)
    sure = dataclasses.replace(noisy, points=noisy.points._replace(log_p=right))
    wrong = dataclasses.replace(noisy, channel=(noisy.channel + 1) % len(ROOMS))
    recipe = train_nesf(replace(TINY, steps=30), ROOMS, [wrong], [sure]).recipe
    assert recipe["history"][-1]["miou"] < 0.9 * recipe["history"][-1]["map_miou"]
    assert recipe["trusted"] <= 0.5 and recipe["validation"]["miou"] > recipe["history"][-1]["miou"]


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Several threads add gradients in an order that changes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_training_on_one_thread_repeats_bit_for_bit(noisy: TrainingMap) -> None:
    config = NesfTrainConfig(steps=3, field=NesfConfig(width=2), labelled_voxels=200)
    one, other = (train_nesf(config, ROOMS, [noisy], [noisy]).model.state_dict() for _ in range(2))
    assert all((one[name] == other[name]).all() for name in one)


def test_training_maps_and_weights_survive_their_files(noisy: TrainingMap, tmp_path: Path) -> None:
    noisy.save(tmp_path / "map.npz")
    again = TrainingMap.load(tmp_path / "map.npz")
    np.testing.assert_array_equal(again.points.xyz, noisy.points.xyz)
    np.testing.assert_allclose(again.points.log_p.astype(np.float32), noisy.points.log_p, atol=0.01)
    np.testing.assert_allclose(again.points.rgb.astype(np.float32), noisy.points.rgb, atol=0.003)
    for name in ("row", "channel", "instance", "count"):
        np.testing.assert_array_equal(getattr(again, name), getattr(noisy, name))
    content = (tmp_path / "map.npz").read_bytes()
    for damaged in (b"no map", b"", content[:-50], content[:5000] + b"damage" + content[5006:]):
        (tmp_path / "other.npz").write_bytes(damaged)
        with pytest.raises(WeightsError, match="not a training map"):
            TrainingMap.load(tmp_path / "other.npz")
    trained = train_nesf(NesfTrainConfig(steps=1, field=NesfConfig(width=2)), ROOMS, [noisy], [noisy])
    save_nesf(trained, tmp_path / "w.safetensors")
    loaded = load_nesf(tmp_path / "w.safetensors")
    assert loaded.model.label_set == ROOMS and loaded.recipe["steps"] == 1 and len(loaded.digest) == 64


def test_the_way_to_objects_is_learned_where_maps_have_instances(noisy: TrainingMap) -> None:
    numbers = [np.where(frame.label == 5, 3, 9).astype(np.uint16) for frame in tiny_frames()]
    told = training_map(make_map(), tiny_frames(), ROOMS, UP, instances=numbers)
    stuff = np.isin(told.channel, [ROOMS.names.index(name) for name in ("wall", "floor")])
    assert (told.instance[stuff] == 0).all() and set(told.instance[~stuff]) <= {3, 9}
    few = replace(TINY, steps=3, centres=1.0)
    untold, told_of = (train_nesf(few, ROOMS, [m], [m]).model for m in (noisy, told))
    assert not untold.config.centres and told_of.config.centres, "label images alone do not tell"
    way = slice(-3, None)
    assert (untold.net.head.weight[way] == 0).all() and (told_of.net.head.weight[way] != 0).any()


def test_targets_are_the_ways_to_whole_objects(noisy: TrainingMap) -> None:
    row = np.flatnonzero(noisy.points.height_m < 0.05)[:1000]
    thing = np.full(len(row), -1)
    thing[:600] = np.arange(600) % 2
    labels = VoxelLabels(row, np.zeros(len(row), np.int64), thing)
    crop = _crop(noisy.points, labels, NesfTrainConfig(labelled_voxels=10_000), np.random.default_rng(0))
    assert crop is not None and (crop.weight > 0).sum() == 600
    length = crop.way.norm(dim=1)
    assert length.max() <= FARTHEST_M + 1e-5
    near = ((length < FARTHEST_M - 1e-4) & (crop.weight > 0)).numpy()
    reached = crop.xyz[near] + crop.way[near].numpy() / CELL_M
    assert near.sum() > 10
    assert len(np.unique(np.rint(reached * 4), axis=0)) <= 4, "those that reach a centre reach one of two"


def test_maps_of_more_classes_are_refined_as_those_of_fewer(noisy: TrainingMap, tmp_path: Path) -> None:
    trained = train_nesf(replace(TINY, steps=10), ROOMS, [noisy], [noisy])
    save_nesf(trained, tmp_path / "w.safetensors")
    more = ROOMS.with_names(("robot",))
    model = find_nesf(tmp_path / "w.safetensors", more).model
    assert model.label_set == more
    own, cells = load_nesf(tmp_path / "w.safetensors").model, pool(noisy.points)
    wide = cells._replace(x=torch.cat((cells.x, torch.zeros(len(cells.x), 1)), dim=1))
    with torch.no_grad():
        expected, found = own(cells), model(wide)
    kept = [*range(len(ROOMS)), *range(len(more), len(more) + 4)]
    torch.testing.assert_close(found[:, kept], expected)
    assert find_nesf(tmp_path / "w.safetensors", make_label_set("two", ("a", "b"))).model.label_set == ROOMS
