"""Fitting an Implicit Ray-Transformer: what stays, what is learned, what is refused."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.errors import FrameError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.device import DeviceField
from semantic_mapper.fields.render import View, render_image
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.labels import make_label_set
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig, IRTFitConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import Budget, FitProgress
from semantic_mapper.training.irt import ClassFit, labelled_rays
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import PosedFrame
from tests.fields.tiny_fields import TINY_IRT
from tests.training.two_planes import CAMERA, HEIGHTS, two_planes

SMALL = FinetuneConfig(
    seconds=0,
    steps=150,
    width=64,
    device="cpu",
    grid=GridFitConfig(long_side=40, rays=512, held_out=0, exposure=False),
    irt=IRTFitConfig(variant="B", carry_labels=False),
)


def fit_irt(
    frames: Sequence[PosedFrame], start: IRT | None = None, config: FinetuneConfig = SMALL, *watched: Any
) -> Checkpoint:
    return finetune(frames, HEIGHTS, start, config, *watched, kind="irt")


@cache
def scene() -> tuple[PosedFrame, ...]:
    """One labelled frame, eleven others."""
    return tuple(two_planes(i * 2 * np.pi / 12, i, label=i == 0) for i in range(12))


def accuracy(field: IRT, query: PosedFrame) -> float:
    view = view_from_frame(query, HEIGHTS, 64)
    encoded = field.encode(stack_sources([view]))
    none = np.zeros((48, 64), np.float32)
    renderer = DeviceField(field, torch.device("cpu"), field.sampling)
    render = render_image(View(renderer, encoded, CAMERA, query.T_world_camera, none, field.sampling))
    found = render.logits.argmax(1)
    return float(((found == view.channel.numpy().flatten()) & render.known).mean())


def test_two_planes_of_one_texture_are_told_apart_by_height_which_a_picture_cannot() -> None:
    query = two_planes(np.pi + 0.2, 99, label=True)
    assert query.label is not None
    checkpoint = fit_irt(scene())
    assert isinstance(checkpoint.model, IRT)
    by_height = accuracy(checkpoint.model, query)
    unet = UNetBaseline(HEIGHTS, UNetConfig(steps=40, width=64))
    unet.fit([scene()[0]])
    by_picture = float((unet.predict(query) == query.label).mean())
    assert by_height > 0.93
    assert by_height > by_picture + 0.1


def test_classes_alone_are_learned_and_held_out_blocks_choose_the_weights() -> None:
    frames = [two_planes(i * 1.0, i, label=True) for i in range(2)]
    config = msgspec.structs.replace(SMALL, steps=12, irt=IRTFitConfig(variant="RTTC"))
    field = fit_irt([*frames, *scene()[1:4]], None, msgspec.structs.replace(config, steps=1)).model
    assert isinstance(field, IRT)
    fit, before = ClassFit(field, labelled_rays(frames, HEIGHTS, config), config), copy.deepcopy(field.state_dict())
    drawn = torch.cat([fit.pool.draw(2048, torch.Generator().manual_seed(i))[0] for i in range(5)])
    assert int(fit.data.held_out.sum()) > 0 and not bool(fit.data.held_out[drawn].any())
    told: list[FitProgress] = []
    best, _ = fit.run(Budget(0, 12, 10, told.append))
    assert best.step == [p for p in told if p.best][-1].step and best.loss == min(p.held_out_loss for p in told)
    moved = {n for n, t in field.state_dict().items() if not torch.equal(t, before[n])}
    assert moved and not any(n.startswith(("grid.", "trunk.", "fitted")) for n in moved)
    assert {"classifier.weight", "image_head.weight", "vote.weight", "points.enter.weight"} <= moved


def test_a_fit_repeats_bit_for_bit_and_comes_back_from_its_file(tmp_path) -> None:
    config = msgspec.structs.replace(SMALL, steps=5, irt=IRTFitConfig())
    frames = [two_planes(0.0, 0, label=True), two_planes(0.5, 1, label=True), *scene()[2:5]]
    first, second = (fit_irt(frames, None, config, None, bool, (77,)) for _ in range(2))
    states = [c.model.state_dict() for c in (first, second)]
    assert all(torch.equal(t, states[1][n]) for n, t in states[0].items())
    assert first.train_stamps_ns == {0, 1, 77} and first.recipe["steps"] == 5 and first.recipe["grid_steps"] == 5
    save_checkpoint(first, tmp_path / "w.safetensors")
    field = load_checkpoint(tmp_path / "w.safetensors").model
    assert isinstance(field, IRT) and field.carried is not None
    assert torch.equal(field.carried.T_camera_world, states[0]["carried.T_camera_world"])  # poses are not rounded
    assert torch.equal(field.carried.channel, states[0]["carried.channel"])
    again = msgspec.structs.replace(config, irt=IRTFitConfig(variant="B"))
    other = fit_irt(frames, field, again).model
    assert isinstance(other, IRT) and other.shape.variant == "B" and other.shape.grid == field.shape.grid


def test_what_cannot_teach_is_refused() -> None:
    unlabelled = [replace(f, label=None) for f in scene()]
    plain = replace(scene()[0], label=np.full((48, 64), HEIGHTS.ids[0], np.uint8))
    refused = {"no frame has a label": unlabelled, "fewer than two classes": [plain, *unlabelled[1:]]}
    for message, frames in refused.items():
        with pytest.raises(FrameError, match=message):
            fit_irt(frames)
    other = IRT(TINY_IRT, make_label_set("other", ["a", "b"]))
    with pytest.raises(WeightsError, match="label set 'other'"):
        fit_irt(scene(), other)
