"""Learning beside a mapper: which keyframes are kept, and which weights are worth offering."""

import dataclasses

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, FrameError, LabelError, PoseError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.learned import build_field
from semantic_mapper.fields.weights import encode_alike
from semantic_mapper.labels import NYU40, ROOMS, make_label_set
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.online import KeyframePool, KeyframeSplit, key_of, learn
from semantic_mapper.types import PosedFrame
from tests.small import settled_field, tiny_field, tiny_frames

FRAMES = tiny_frames(8)
CONFIG = convert_config(
    {"finetune": {"steps": 6, "width": 96, "held_out_rays": 64, "step": {"rays": 128}}}, OnlineConfig, "test"
)


def start_of(*stamps_ns: int) -> Checkpoint:
    """Random weights, but for an encoder that has seen images."""
    return Checkpoint(settled_field(), (), {"width": 96, "train_stamps_ns": list(stamps_ns)})


def pool_of(frames=(), **changes: int) -> KeyframePool:
    pool = KeyframePool(ROOMS, **{"held_out_every": 4, "capacity": 8, **changes})
    for frame in frames:
        pool.add(frame, ROOMS)
    return pool


def permuted(frame: PosedFrame) -> PosedFrame:
    """Each class called as the next one."""
    assert frame.label is not None
    return dataclasses.replace(frame, label=np.where(frame.label > 0, frame.label % len(ROOMS) + 1, 0).astype(np.uint8))


def scrambled(frame: PosedFrame, seed: int) -> PosedFrame:
    """Labels that have nothing to do with the image: those of its pixels, in any order."""
    assert frame.label is not None
    mixed = np.random.default_rng(seed).permutation(frame.label.ravel()).reshape(frame.label.shape)
    return dataclasses.replace(frame, label=mixed)


def test_every_fourth_keyframe_is_held_out_for_good_and_the_oldest_goes() -> None:
    pool = pool_of(FRAMES[:6], capacity=5)
    split = pool.split()
    assert [f.seq for f in split.train] == [FRAMES[i].seq for i in (1, 2, 4, 5)]
    assert [f.seq for f in split.held_out] == [FRAMES[3].seq]
    pool.add(FRAMES[3], ROOMS)  # labelled once more: it judges still
    assert [f.seq for f in pool.split().held_out] == [FRAMES[3].seq] and len(pool) == 5


def test_keyframes_are_validated_or_dropped() -> None:
    pool = pool_of(FRAMES[:4])
    first = [key_of(f) for f in FRAMES[:4]]
    pool.validate(first)
    assert pool.new == 0 and pool.split().validated == set(first)
    pool.add(FRAMES[4], ROOMS)
    pool.add(FRAMES[5], ROOMS)
    assert pool.reject([*first, key_of(FRAMES[4])], worse=True) == 1 and len(pool) == 5
    assert pool.new == 1  # what has not been tried yet stays
    pool.add(permuted(FRAMES[0]), ROOMS)  # labelled again: not validated
    assert pool.new == 2 and key_of(FRAMES[0]) not in pool.split().validated


def test_keyframes_of_rounds_without_success_stay_for_three_rounds() -> None:
    pool = pool_of(FRAMES[:2])
    pool.validate([key_of(FRAMES[0])])
    keys = [key_of(f) for f in FRAMES[:2]]
    assert [pool.reject(keys, worse=False) for _ in range(2)] == [0, 0] and (len(pool), pool.new) == (2, 0)
    pool.add(FRAMES[2], ROOMS)
    again = pool_of()
    for kept in pool.kept:
        again.restore(kept, ROOMS)
    assert [(k.frame.seq, k.validated, k.trials) for k in again.kept] == [
        (FRAMES[0].seq, True, 0),
        (FRAMES[1].seq, False, 2),
        (FRAMES[2].seq, False, 0),
    ]
    assert again.new == 1 and again.split().validated == {keys[0]}
    assert again.reject([*keys, key_of(FRAMES[2])], worse=False) == 1 and len(again) == 2  # the third time
    again.validate([key_of(FRAMES[2])])
    assert again.kept[-1].trials == 0


def test_labels_are_translated_by_class_name() -> None:
    own = make_label_set("kitchen", ("oven", "floor"), ids=(3, 9))
    label = np.zeros_like(FRAMES[0].label)
    label[:10], label[10:20] = 3, 9
    pool = pool_of()
    pool.add(dataclasses.replace(FRAMES[0], label=label), own)
    kept = pool.split().train[0].label
    assert kept is not None and set(np.unique(kept[10:20])) == {ROOMS.id_of("floor")} and not kept[:10].any()


def test_what_cannot_be_learned_from_is_refused_and_changes_nothing() -> None:
    pool = pool_of(FRAMES[:1])
    frame = FRAMES[1]
    small = {n: getattr(frame, n)[:36, :48] for n in ("rgb", "depth_m", "label")}
    small["intrinsics"] = dataclasses.replace(frame.intrinsics, width=48, height=36)
    unknown = np.full_like(frame.label, NYU40.id_of("whiteboard"))
    for changes, labels, error, says in (
        ({"label": None}, ROOMS, FrameError, "no label image"),
        ({"label": np.full_like(frame.label, 200)}, ROOMS, LabelError, "200"),
        ({"label": unknown}, NYU40, FrameError, "none of its pixels is of a class that the weights know"),
        ({"T_world_camera": np.eye(4) * 2}, ROOMS, PoseError, "keyframe seq="),
        (small, ROOMS, FrameError, "48x36 pixels, but those before have 96x72"),
    ):
        with pytest.raises(error, match=says):
            pool.add(dataclasses.replace(frame, **changes), labels)
    assert len(pool) == 1


def test_good_labels_make_better_weights_whose_encoder_is_the_old_one() -> None:
    start = start_of(77)
    steps: list[int] = []
    result = learn(pool_of(FRAMES).split(), start, CONFIG, lambda p: steps.append(p.step))
    assert result.refusal == "" and result.score > result.parent_score + 0.2
    assert steps[-1] == 6
    made = result.checkpoint
    assert encode_alike(made.weights, start.weights)
    assert not torch.equal(made.model.state_dict()["classifier.bias"], start.model.state_dict()["classifier.bias"])
    assert made.train_stamps_ns == {77} | {f.stamp_ns for f in FRAMES}  # those that judge are not scored on either
    assert [a.seq for a in made.anchors] == [f.seq for f in pool_of(FRAMES).split().train]
    again = learn(pool_of(FRAMES).split(), start, CONFIG)
    assert again.score == result.score
    state = made.model.state_dict()
    assert all(torch.equal(t, state[name]) for name, t in again.checkpoint.model.state_dict().items())


def test_labels_that_have_nothing_to_do_with_the_images_are_refused() -> None:
    start = learn(pool_of(FRAMES[:4]).split(), start_of(), CONFIG).checkpoint
    bad = pool_of([scrambled(f, i) for i, f in enumerate(FRAMES[4:])])
    result = learn(bad.split(), start, CONFIG)
    assert result.score < 0.2 and "less than 0.2 (least_score)" in result.refusal and result.worse
    hardly = msgspec.structs.replace(CONFIG.finetune, steps=1, learning_rate=1e-9)
    once_more = learn(pool_of(FRAMES[4:]).split(), start, OnlineConfig(least_gain=0.5, finetune=hardly))
    assert once_more.score > 0.5 and "less than 0.5 gained" in once_more.refusal


def test_labels_that_contradict_validated_ones_are_refused_although_they_agree_with_each_other() -> None:
    pool = pool_of(FRAMES[:4])
    start = learn(pool.split(), start_of(), CONFIG).checkpoint
    pool.validate([key_of(f) for f in FRAMES[:4]])
    for frame in FRAMES[4:]:
        pool.add(permuted(frame), ROOMS)
    result = learn(pool.split(), start, msgspec.structs.replace(CONFIG, least_gain=0.0))
    assert "contradict the old ones" in result.refusal and result.worse


def test_too_few_keyframes_and_an_encoder_that_learns_are_refused() -> None:
    start = start_of()
    with pytest.raises(FrameError, match="1 to judge by, got 2 and 0"):
        learn(KeyframeSplit(FRAMES[:2], ()), start, CONFIG)
    with pytest.raises(ConfigError, match="frozen_encoder_fraction must be 1"):
        convert_config({"finetune": {"frozen_encoder_fraction": 0.5}}, OnlineConfig, "test")
    for model in (build_field("unet", {}, ROOMS), tiny_field()):
        with pytest.raises(WeightsError, match="cannot be finetuned with a frozen encoder"):
            learn(pool_of(FRAMES).split(), Checkpoint(model, (), {}), CONFIG)
