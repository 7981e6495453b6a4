import dataclasses
import json
import re

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.weights import anchor_from_frame, encode_alike, load_weights, weights_bytes
from semantic_mapper.labels import NYU40, ROOMS
from semantic_mapper.mapper import Mapper
from tests.small import tiny_field, tiny_frames


def test_round_trip_keeps_weights_labels_recipe_and_anchors(tmp_path):
    anchors = tuple(anchor_from_frame(f, 64) for f in tiny_frames(2))
    saved = Checkpoint(tiny_field(), anchors, {"train_stamps_ns": [5, 7], "width": 64})
    save_checkpoint(saved, tmp_path / "w.safetensors")
    loaded = load_checkpoint(tmp_path / "w.safetensors")
    for name, tensor in saved.model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], tensor)
    assert encode_alike(load_weights(tmp_path / "w.safetensors"), saved.weights), "to the shape of every tensor"
    assert loaded.label_set == ROOMS and loaded.model.config == saved.model.config
    assert loaded.train_stamps_ns == {5, 7} and loaded.width == 64
    for a, b in zip(loaded.anchors, anchors, strict=True):
        assert np.array_equal(a.rgb, b.rgb) and np.array_equal(a.depth_m, b.depth_m)
        assert np.array_equal(a.T_world_camera, b.T_world_camera) and a.intrinsics == b.intrinsics
        assert np.array_equal(a.label, b.label) and a.label.shape == (48, 64)


def test_damaged_files_and_those_of_others_are_refused(tmp_path):
    path, broken = tmp_path / "w.safetensors", tiny_field()
    broken.classifier.weight.data[0, 0] = float("nan")
    for load in (Mapper.load, load_checkpoint):
        save_checkpoint(Checkpoint(broken), path)
        with pytest.raises(WeightsError, match="NaN"):
            load(path)
        for keep in (100, 0):
            path.write_bytes(path.read_bytes()[:keep])
            with pytest.raises(WeightsError, match=r"w\.safetensors"):
                load(path)
        save_file({"x": torch.zeros(3)}, path)
        with pytest.raises(WeightsError, match="not weights of this project"):
            load(path)
        with pytest.raises(WeightsError, match="no such weights file"):
            load(tmp_path / "none.safetensors")


@pytest.mark.parametrize("load", [Mapper.load, load_checkpoint])
def test_every_tensor_must_be_there_and_fit_and_none_else(tmp_path, load):
    path, weights = tmp_path / "w.safetensors", Checkpoint(tiny_field()).weights
    for name, tensor in weights.tensors.items():
        if name.endswith("num_batches_tracked"):
            continue
        rest = {n: t for n, t in weights.tensors.items() if n != name}
        short = rest | {name: np.zeros(tensor.size + 2, np.float32)}
        for tensors in (rest, short):
            path.write_bytes(weights_bytes(dataclasses.replace(weights, tensors=tensors)))
            with pytest.raises(WeightsError, match=r"w\.safetensors: weights do not fit .*" + re.escape(name)):
                load(path)
    for more in ({"extra.weight": np.zeros(3, np.float32)}, {}):
        label_set = weights.label_set if more else NYU40
        others = dataclasses.replace(weights, tensors={**weights.tensors, **more}, label_set=label_set)
        path.write_bytes(weights_bytes(others))
        with pytest.raises(WeightsError, match=r"w\.safetensors: weights do not fit .*(extra|classifier)\.weight"):
            load(path)


def change_metadata(path, **changes):
    with safe_open(path, framework="pt") as stored:
        metadata = dict(stored.metadata())
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 - not a dict
    save_file(tensors, path, metadata | {name: json.dumps(value) for name, value in changes.items()})


@pytest.mark.parametrize(
    "changes",
    [
        {"recipe": []},
        {"recipe": {"width": 0}},
        {"recipe": {"train_stamps_ns": ["soon"]}},
        {"model_config": {"heads": 0}},
        {"model_config": {"feature_dim": 10**9}},
        {"model_config": {"encoder": {"blocks": [65, 1]}}},
        {"model_config": {"feature_din": 16}},
        {"label_set": {"name": "x"}},
        {"anchors": [{"seq": 1}]},
    ],
    ids=str,
)
def test_metadata_that_cannot_be_used_are_refused_with_the_reason(tmp_path, changes):
    path = tmp_path / "w.safetensors"
    save_checkpoint(Checkpoint(tiny_field()), path)
    change_metadata(path, **changes)
    with pytest.raises(WeightsError, match=r"w\.safetensors: its metadata is damaged: \w+: "):
        load_checkpoint(path)


def test_anchors_with_computed_depth_keep_its_spread(tmp_path):
    frame = tiny_frames(1)[0]
    computed = dataclasses.replace(frame, depth_sigma_m=np.float32(0.05) * frame.depth_m)
    save_checkpoint(
        Checkpoint(tiny_field(), (anchor_from_frame(computed, 64), anchor_from_frame(frame, 64))), tmp_path / "w"
    )
    kept, measured = load_checkpoint(tmp_path / "w").anchors
    assert measured.depth_sigma_m is None
    np.testing.assert_allclose(kept.depth_sigma_m, 0.05 * kept.depth_m, atol=5e-4)


def test_a_missing_file_is_named_with_one_that_is_there(tmp_path):
    (tmp_path / "kitchen.safetensors").touch()
    with pytest.raises(
        WeightsError, match=r"kichen\.safetensors: no such weights file.*did you mean `kitchen\.safetensors`"
    ):
        load_checkpoint(tmp_path / "kichen.safetensors")
