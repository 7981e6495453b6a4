import dataclasses
import math

import pytest
import torch

from semantic_mapper.config import convert_config
from semantic_mapper.errors import FrameError
from semantic_mapper.fields import device
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.losses import image_loss
from semantic_mapper.training.views import stack_sources, view_from_frame
from tests.fields.tiny_fields import tiny
from tests.small import tiny_field, tiny_frames


def config(**changes: object) -> FinetuneConfig:
    base = {"seconds": 0, "steps": 6, "width": 96, "held_out_rays": 64, "evaluations": 3, "step": {"rays": 128}}
    return convert_config({**base, **changes}, FinetuneConfig, "test config")


def test_finetuning_improves_held_out_rays_and_says_what_it_did():
    seen: list[float] = []
    result = finetune(tiny_frames(4), ROOMS, tiny_field(), config(steps=40), lambda p: seen.append(p.held_out_loss))
    assert result.recipe["held_out_loss"] < seen[0]
    assert result.recipe["held_out_loss"] == min(seen)
    assert result.train_stamps_ns == {f.stamp_ns for f in tiny_frames(4)}
    assert len(result.anchors) == 4 and all(a.label is not None for a in result.anchors)


def test_weights_are_never_worse_than_the_start_on_held_out_rays():
    ruined = config(steps=12, learning_rate=30.0, image_fraction=0.0)
    start, seen = calibrated_field(), list[FitProgress]()
    result = finetune(tiny_frames(3), ROOMS, start, ruined, seen.append)
    assert not seen[0].best, "what it says of held-out rays is of the start still"
    assert seen[0].held_out_loss >= result.recipe["held_out_loss"]
    if result.recipe["best_step"] == 0:
        fitted = dict(result.model.named_parameters())
        changed = {name for name, p in start.named_parameters() if not torch.equal(fitted[name], p)}
        assert changed <= set(SRay.class_rows), "before the first step its classifier is fitted alone"
    assert math.isfinite(result.recipe["held_out_loss"])


def test_the_encoder_computes_as_before_once_bfloat16_is_over(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(device, "bfloat16_is_fast", lambda _: True)
    field = tiny_field().eval()
    views = stack_sources([view_from_frame(f, ROOMS, 96) for f in tiny_frames(2)])
    with torch.inference_mode():
        exact = field.encode(views).feature
        with device.encoder_in_bfloat16(field, torch.device("cpu")):
            rounded = field.encode(views).feature
        again = field.encode(views).feature
    assert torch.equal(exact, again) and rounded.dtype == torch.float32
    assert 0 < (rounded - exact).abs().max() < 0.1 * exact.abs().max()


def calibrated_field():
    """Random weights whose norms are set: no fresh field to a finetuning."""
    field = tiny_field()
    calibrate(field.encoder, stack_sources([view_from_frame(f, ROOMS, 96) for f in tiny_frames(2)]))
    return field


def test_steps_on_images_teach_the_own_image_and_adapt_the_norms():
    frames, start = tiny_frames(4), calibrated_field()
    kept = config(steps=30, held_out_fraction=0.0, image_fraction=1.0)  # the last weights are kept
    fitted = finetune(frames, ROOMS, start, kept).model
    views = stack_sources([view_from_frame(f, ROOMS, 96) for f in frames], with_labels=True)
    with torch.inference_mode():
        before, after = (
            image_loss(f.eval().source_logits(f.encode(views)), views.channel, 0.0) for f in (start, fitted)
        )
    assert after < 0.7 * before
    before, after = start.state_dict(), fitted.state_dict()
    assert any(not torch.equal(after[n], before[n]) for n in before if n.endswith("running_mean"))


@pytest.mark.parametrize(
    ("changes", "depth", "factors"),
    [({}, True, [4.0, 1e3]), ({"encoder_rate": 0.0}, True, [1.0, 1.0]), ({}, False, [1.0, 1.0])],
)
def test_the_own_image_counts_more_where_its_encoder_learned_the_scene(
    changes: dict[str, float], depth: bool, factors: list[float]
):
    frames = [f if depth else dataclasses.replace(f, depth_m=None) for f in tiny_frames(4)]
    result = finetune(frames, ROOMS, calibrated_field(), config(steps=2, **changes))
    model = result.model
    assert isinstance(model, SRay) and model.own_view_factor.tolist() == factors
    wanted = {"factor": 4.0, "factor_without_depth": 1e3} if factors[0] > 1 else {}
    assert result.recipe["own_view"] == wanted


def test_a_per_image_network_is_finetuned_and_judged_on_its_own_views():
    seen: list[float] = []
    start, budget = tiny("unet", label_set=ROOMS), config(steps=40, frozen_encoder_fraction=0.5)
    result = finetune(tiny_frames(4), ROOMS, start, budget, lambda p: seen.append(p.held_out_loss))
    assert result.recipe["held_out_loss"] < 0.9 * seen[0]


def test_a_stop_request_ends_it_with_the_best_weights_so_far():
    steps: list[int] = []
    result = finetune(
        tiny_frames(3), ROOMS, tiny_field(), config(steps=500), lambda p: steps.append(p.step), lambda: len(steps) >= 5
    )
    assert steps == [1, 2, 3, 4, 5] and result.recipe["steps"] == 5
    assert result.recipe["best_step"] in (0, 5)


def test_too_few_or_unlabelled_keyframes_are_refused():
    for frames in (tiny_frames(4)[:1], [dataclasses.replace(f, label=None) for f in tiny_frames(3)]):
        with pytest.raises(FrameError, match="at least 2 frames, one of them labelled"):
            finetune(frames, ROOMS, None, config())


def test_frames_without_labels_are_source_views_only():
    frames = tiny_frames(4)
    given = [frames[0], *(dataclasses.replace(f, label=None) for f in frames[1:])]
    result = finetune(given, ROOMS, tiny_field(), config(steps=20))
    assert result.recipe["steps"] == 20 and result.recipe["best_step"] > 0
    assert result.train_stamps_ns == {frames[0].stamp_ns}, "the others' labels are not used"
    assert len(result.anchors) == 1
