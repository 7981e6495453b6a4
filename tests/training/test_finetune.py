import dataclasses
import math

import numpy as np
import pytest
import torch

import semantic_mapper.training.finetune as finetuning
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields import device
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.registry import build_field
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.finetune import FinetuneConfig, FinetuneProgress, finetune
from semantic_mapper.training.losses import image_loss
from semantic_mapper.training.select import Candidate, candidate_from_frame, choose_keyframes
from semantic_mapper.training.uncertainty import LEAST, with_uncertainty
from semantic_mapper.training.views import stack_sources, view_from_frame
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
    ruined = config(steps=12, linear_probe_steps=0, learning_rate=30.0, final_learning_rate=30.0, gradient_clip=1e6)
    start, seen = calibrated_field(), list[FinetuneProgress]()
    result = finetune(tiny_frames(3), ROOMS, start, ruined, seen.append)
    assert not seen[0].best, "what it says of held-out rays is of the start still"
    assert seen[0].held_out_loss >= result.recipe["held_out_loss"]
    if result.recipe["best_step"] == 0:
        fitted = dict(result.model.named_parameters())
        assert all(torch.equal(fitted[name], p) for name, p in start.named_parameters())
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


def test_without_patience_a_budget_is_spent_to_its_end():
    hopeless = {"learning_rate": 30.0, "final_learning_rate": 30.0, "gradient_clip": 1e6, "evaluations": 10}
    start, fresh = calibrated_field(), tiny_field()

    def steps(field: SRay, patience: int, images: float = 0.0) -> int:
        given = config(steps=20, patience=patience, image_fraction=images, **hopeless)
        return finetune(tiny_frames(3), ROOMS, field, given).recipe["steps"]

    assert steps(start, 2) < 15
    assert 15 < steps(start, 2, 0.75) < 20, "looks during steps on images do not count"
    assert steps(start, 0) == 20
    assert steps(fresh, 2) == 20, "random weights get worse before they get better"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
def test_finetuning_runs_on_a_gpu():
    result = finetune(
        tiny_frames(3), ROOMS, tiny_field().to("cuda"), config(steps=4, step={"hard_example_fraction": 0.5})
    )
    assert result.recipe["steps"] == 4 and math.isfinite(result.recipe["held_out_loss"])


def test_a_budget_of_nothing_is_refused():
    with pytest.raises(ConfigError, match="needs a budget"):
        finetune(tiny_frames(3), ROOMS, tiny_field(), config(steps=0))


def calibrated_field():
    """Random weights whose norms are set: no fresh field to a finetuning."""
    field = tiny_field()
    calibrate(field.encoder, stack_sources([view_from_frame(f, ROOMS, 96) for f in tiny_frames(2)]))
    return field


def running_means(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: t.clone() for name, t in model.state_dict().items() if name.endswith("running_mean")}


def test_norms_live_in_a_field_of_which_nothing_is_trained_and_rest_in_any_other():
    start = calibrated_field()
    rested = running_means(finetune(tiny_frames(2), ROOMS, start, config(steps=3, image_fraction=0.0)).model)
    assert rested and all(torch.equal(rested[name], t) for name, t in running_means(start).items())

    frames = tiny_frames(2)
    lived = finetune(
        frames, ROOMS, tiny_field(), config(steps=3, held_out_fraction=0.0, bfloat16=False)
    ).model  # the last weights are kept
    means = running_means(lived)
    calibrate(lived.encoder, stack_sources([view_from_frame(f, ROOMS, 96) for f in frames]))
    for name, settled in running_means(lived).items():
        assert torch.allclose(means[name], settled, atol=1e-4), "what is kept has the statistics of all its views"
        assert not torch.equal(settled, torch.zeros_like(settled))


def test_held_out_rays_are_judged_without_labels_where_training_knows_none():
    step = {"rays": 128, "known_labels": False}
    still = {"steps": 1, "learning_rate": 0.0, "final_learning_rate": 0.0, "weight_decay": 0.0}
    given, kept = (finetune(tiny_frames(3), ROOMS, tiny_field(), config(**still, **c)) for c in ({}, {"step": step}))
    assert given.recipe["held_out_loss"] < kept.recipe["held_out_loss"], "labels of the others say much"


def test_a_head_start_fits_the_classifier_alone():
    frames, start = tiny_frames(3), calibrated_field()
    still = {"steps": 1, "learning_rate": 0.0, "final_learning_rate": 0.0, "weight_decay": 0.0}
    plain, ahead = (finetune(frames, ROOMS, start, config(**still, linear_probe_steps=n)) for n in (0, 40))
    assert ahead.recipe["held_out_loss"] < plain.recipe["held_out_loss"]
    changed = {n for n, p in ahead.model.named_parameters() if not torch.equal(p, start.state_dict()[n])}
    assert changed == set(SRay.class_rows)


def test_a_head_start_that_does_no_good_is_undone(monkeypatch: pytest.MonkeyPatch):
    def ruin(model: SRay, *_: object) -> bool:
        with torch.no_grad():
            model.classifier.bias.add_(torch.linspace(-9, 9, len(ROOMS)))
        return True

    monkeypatch.setattr("semantic_mapper.training.finetune.fit_class_rows", ruin)
    start = calibrated_field()
    still = {"steps": 1, "learning_rate": 0.0, "final_learning_rate": 0.0, "weight_decay": 0.0}
    fitted = finetune(tiny_frames(3), ROOMS, start, config(**still)).model.state_dict()
    assert torch.equal(fitted["classifier.bias"], start.state_dict()["classifier.bias"])


def test_an_encoder_of_rate_0_stays_what_it_was_and_the_rest_learns():
    start = tiny_field()
    result = finetune(tiny_frames(4), ROOMS, start, config(steps=30, encoder_rate=0.0))
    fitted = dict(result.model.named_parameters())
    same = {name: torch.equal(fitted[name], p) for name, p in start.named_parameters()}
    assert result.recipe["best_step"] > 0
    assert all(unchanged for name, unchanged in same.items() if name.startswith("encoder."))
    assert not all(same.values())


def test_the_encoder_may_rest_at_the_start_and_its_weights_stay_what_they_were():
    start = calibrated_field()
    result = finetune(tiny_frames(4), ROOMS, start, config(steps=30, linear_probe_steps=0, frozen_encoder_fraction=1.0))
    assert result.recipe["best_step"] > 0, "the head alone learns something"
    kept = {n: t for n, t in result.model.named_parameters() if n.startswith(("encoder.", "geometry_init."))}
    assert kept and all(torch.equal(start.state_dict()[n], t) for n, t in kept.items())
    later = finetune(tiny_frames(4), ROOMS, start, config(steps=40, linear_probe_steps=0, frozen_encoder_fraction=0.2))
    assert later.recipe["best_step"] > 8, "it learns more once the encoder may"
    assert any(not torch.equal(t, dict(later.model.named_parameters())[n]) for n, t in kept.items())


def test_an_encoder_that_has_learned_nothing_yet_does_not_rest():
    kept, fresh = calibrated_field(), tiny_field()
    for start, rests in ((kept, True), (fresh, False)):
        config_ = config(steps=3, frozen_encoder_fraction=1.0, held_out_fraction=0.0)  # the last weights are kept
        fitted = dict(finetune(tiny_frames(3), ROOMS, start, config_).model.named_parameters())
        assert all(torch.equal(fitted[n], p) for n, p in start.named_parameters() if n.startswith("encoder.")) == rests


def test_steps_on_images_teach_the_own_image_and_adapt_the_norms():
    frames, start = tiny_frames(4), calibrated_field()
    kept = config(steps=30, held_out_fraction=0.0, image_fraction=1.0)  # the last weights are kept
    fitted = finetune(frames, ROOMS, start, kept).model
    views = stack_sources([view_from_frame(f, ROOMS, 96) for f in frames])
    channel = torch.stack([view_from_frame(f, ROOMS, 96).channel for f in frames])
    losses = []
    for field in (start, fitted):
        with torch.inference_mode():
            logits = field.eval().source_logits(field.encode(views))
        assert logits is not None
        losses.append(float(image_loss(logits, channel, 0.0)))
    assert losses[1] < 0.7 * losses[0]
    assert any(not torch.equal(running_means(fitted)[n], t) for n, t in running_means(start).items())


def test_steps_on_images_are_the_first_ones_behind_a_resting_encoder(monkeypatch: pytest.MonkeyPatch):
    made: list[str] = []

    def noted(name, draw):
        def step(*given):
            made.append(name)
            return draw(*given)

        return step

    for name in ("_draw_loss", "_draw_image_loss"):
        monkeypatch.setattr(finetuning, name, noted(name, getattr(finetuning, name)))
    rest = {"frozen_encoder_fraction": 0.2, "image_fraction": 0.45, "patience": 0}
    finetune(tiny_frames(3), ROOMS, calibrated_field(), config(steps=10, **rest))
    assert made == ["_draw_loss"] * 2 + ["_draw_image_loss"] * 4 + ["_draw_loss"] * 4
    made.clear()
    finetune(tiny_frames(3), ROOMS, calibrated_field(), config(steps=3, encoder_rate=0.0))
    assert made == ["_draw_loss"] * 3, "an encoder that is to stay what it is learns no images"


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


def test_doubt_is_what_the_images_alone_give_to_other_classes_than_the_right_one():
    views = [view_from_frame(f, ROOMS, 96) for f in tiny_frames(2)]
    field = tiny_field()
    with torch.no_grad():
        field.classifier.weight.zero_()
        field.classifier.bias.zero_()
        field.classifier.bias[int(views[0].channel.max())] = 9.0
    for view, plain in zip(with_uncertainty(field, views), views, strict=True):
        assert view.uncertainty is not None and view.uncertainty.shape == plain.channel.shape
        sure = plain.channel == int(views[0].channel.max())
        assert view.uncertainty[sure].max() == pytest.approx(LEAST)
        assert view.uncertainty[~sure & (plain.channel >= 0)].min() > 0.9
        assert not view.uncertainty[plain.channel < 0].any()
    assert with_uncertainty(build_field("semantic_nerf", {}, ROOMS), views)[0].uncertainty is None


def test_rays_may_go_where_the_field_is_in_doubt():
    start = tiny_field()
    step = {"rays": 128, "hard_example_fraction": 0.5}
    plain, doubtful = (finetune(tiny_frames(4), ROOMS, start, config(steps=20, **c)) for c in ({}, {"step": step}))
    assert doubtful.recipe["best_step"] > 0 and plain.recipe["held_out_loss"] != doubtful.recipe["held_out_loss"]


def test_a_per_image_network_is_finetuned_and_judged_on_its_own_views():
    torch.manual_seed(0)
    shape = {"feature_dim": 16, "encoder": {"channels": [8, 16], "blocks": [1, 1]}}
    seen: list[float] = []
    start = build_field("unet", shape, ROOMS)
    result = finetune(
        tiny_frames(4),
        ROOMS,
        start,
        config(steps=40, frozen_encoder_fraction=0.5),
        lambda p: seen.append(p.held_out_loss),
    )
    assert result.recipe["held_out_loss"] < 0.9 * seen[0]


def test_a_stop_request_ends_it_with_the_best_weights_so_far():
    steps: list[int] = []
    result = finetune(
        tiny_frames(3), ROOMS, tiny_field(), config(steps=500), lambda p: steps.append(p.step), lambda: len(steps) >= 5
    )
    assert steps == [1, 2, 3, 4, 5] and result.recipe["steps"] == 5
    assert result.recipe["best_step"] in (0, 5)


def test_same_seed_and_steps_give_the_same_weights():
    a = finetune(tiny_frames(3), ROOMS, tiny_field(), config())
    b = finetune(tiny_frames(3), ROOMS, tiny_field(), config())
    c = finetune(tiny_frames(3), ROOMS, tiny_field(), config(seed=1))
    assert all(
        torch.equal(x, y) for x, y in zip(a.model.state_dict().values(), b.model.state_dict().values(), strict=True)
    )
    assert any(
        not torch.equal(x, y) for x, y in zip(a.model.state_dict().values(), c.model.state_dict().values(), strict=True)
    )


def test_too_few_or_unlabelled_keyframes_are_refused():
    with pytest.raises(FrameError, match="at least 2 frames, one of them labelled"):
        finetune(tiny_frames(4)[:1], ROOMS, None, config())
    blind = [dataclasses.replace(f, label=None) for f in tiny_frames(3)]
    with pytest.raises(FrameError, match="at least 2 frames, one of them labelled"):
        finetune(blind, ROOMS, None, config())


def test_frames_without_labels_are_source_views_only():
    frames = tiny_frames(4)
    given = [frames[0], *(dataclasses.replace(f, label=None) for f in frames[1:])]
    result = finetune(given, ROOMS, tiny_field(), config(steps=20))
    assert result.recipe["steps"] == 20 and result.recipe["best_step"] > 0
    assert result.train_stamps_ns == {frames[0].stamp_ns}, "the others' labels are not used"
    assert len(result.anchors) == 1


class FakeTime:
    """A clock that ticks where a finetuning spends time: 2 s a look, 1 s a step."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.looks = 0
        monkeypatch.setattr("semantic_mapper.training.budget.time.monotonic", lambda: self.now)
        evaluate = finetuning._evaluate

        def look(*given):
            self.now += 2.0
            self.looks += 1
            return evaluate(*given)

        def timed(draw):
            def step(*given):
                self.now += 1.0
                return draw(*given)

            return step

        monkeypatch.setattr(finetuning, "_evaluate", look)
        for draw in ("_draw_loss", "_draw_image_loss"):
            monkeypatch.setattr(finetuning, draw, timed(getattr(finetuning, draw)))


def test_a_time_budget_holds_all_of_it_the_last_look_included(monkeypatch: pytest.MonkeyPatch):
    clock = FakeTime(monkeypatch)
    spent: list[float] = []
    still = config(seconds=20.0, steps=0, patience=0, evaluations=2, linear_probe_steps=0)
    result = finetune(tiny_frames(3), ROOMS, calibrated_field(), still, lambda p: spent.append(p.fraction))
    assert clock.looks == 3, "at the start, in the middle and at the end"
    assert result.recipe["steps"] == len(spent) == 14
    assert result.recipe["seconds"] == 20.0
    assert spent[-1] == 1.0 and all(0 < share < 1 for share in spent[:-1])


def test_where_the_first_look_takes_all_the_time_no_step_begins(monkeypatch: pytest.MonkeyPatch):
    FakeTime(monkeypatch)
    result = finetune(tiny_frames(3), ROOMS, calibrated_field(), config(seconds=2.5, steps=0, linear_probe_steps=0))
    assert result.recipe["steps"] == 0 and result.recipe["seconds"] == 2.0


@pytest.mark.parametrize(
    "bad",
    [
        {"seed": -1},
        {"held_out_fraction": 1.0},
        {"held_out_rays": 0},
        {"evaluations": 0},
        {"learning_rate": -1.0},
        {"step": {"rays": 0}},
        {"step": {"views_min": 5, "views_max": 3}},
        {"step": {"views_max": 40}},
        {"step": {"balanced_fraction": 3.0}},
        {"step": {"no_depth_thinning": 0}},
    ],
)
def test_settings_that_make_no_sense_are_refused(bad: dict[str, object]):
    with pytest.raises(ConfigError, match="test config"):
        config(**bad)


def test_chosen_keyframes_cover_different_places():
    def cells(start: int) -> np.ndarray:
        return np.stack([np.arange(start, start + 50), np.zeros(50, int), np.zeros(50, int)], axis=1)

    candidates = [Candidate(i, cells(start)) for i, start in enumerate([0, 1, 2, 100, 101, 200])]
    chosen = choose_keyframes(candidates, 3, seed=0)
    assert len(set(chosen) & {0, 1, 2}) == 1 and len(set(chosen) & {3, 4}) == 1 and 5 in chosen


def test_choice_is_decided_by_the_seed_and_gives_as_many_as_asked():
    candidates = [candidate_from_frame(f) for f in tiny_frames(6)]
    assert choose_keyframes(candidates, 4, 3) == choose_keyframes(candidates, 4, 3)
    assert len(choose_keyframes(candidates, 4, 3)) == 4
    assert choose_keyframes(candidates, 99, 0) == list(range(6))


def test_frames_without_depth_are_spread_over_time():
    blind = [Candidate(i, np.zeros((0, 3), np.int64)) for i in range(100)]
    chosen = choose_keyframes(blind, 4, 0)
    assert len(chosen) == 4 and min(np.diff(chosen)) >= 15
