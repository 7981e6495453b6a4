from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from research.suites.config import SuiteConfig, fit_config
from research.suites.entries import load_entries
from research.suites.figures import compare_with_carried, view_figures
from research.suites.predict import predict_view
from research.suites.protocols import (
    Entry,
    RoomResult,
    answer_from_keyframes,
    choose_fitted,
    run_room,
)
from research.suites.rooms import as_given
from research.suites.scene_box import scene_config
from research.suites.scoring import from_rows
from research.tests.suites.tiny import tiny_contestant, tiny_room, tiny_suite
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.sampling import around_computed
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import SourceViews
from tests.small import tiny_field


class Watched(SRay):
    """Remembers what it was given."""

    kind = "sray"

    def encode(self, views: SourceViews):
        self.seen = views
        return super().encode(views)


class OwnView(Watched):
    needs_own_view = True


def watched(kind: type[Watched] = Watched) -> Watched:
    field = tiny_field()
    copy = kind(field.config, ROOMS).eval()
    copy.load_state_dict(field.state_dict())
    return copy


def score(entry: Entry, suite: SuiteConfig, on_fit: Callable[[float], None] | None = None) -> RoomResult:
    result = run_room(tiny_room(suite.depth), entry, suite, on_fit)
    assert result is not None
    return result


@pytest.mark.slow
@pytest.mark.parametrize("own_image", [True, False])
def test_generalizing_scores_whole_views_with_or_without_the_image_of_the_query(own_image: bool) -> None:
    room = tiny_room()
    record = score(tiny_contestant(), tiny_suite(own_image=own_image)).record
    assert [i.frame for i in record.images] == [6, 8]
    for image in record.images:
        assert len(image.sources) == 3 and (image.sources[-1] == image.frame) == own_image
        assert image.frame not in image.sources[:-1] and (image.psnr_db is None) == own_image
    labelled = sum(int((t.label != ROOMS.ignore_id).sum()) for t in room.truth.values())
    assert from_rows(record.confusion).metrics().pixels == labelled
    assert record.compared > 100 and 0 <= record.agreeing <= record.compared
    assert sum(record.calibration.count) <= labelled
    assert not record.curve and not record.keyframes


def test_the_query_is_a_source_only_of_a_kind_that_needs_it() -> None:
    record = score(Entry("own", "own", watched(OwnView)), tiny_suite()).record
    assert all(len(i.sources) == 3 and i.sources[-1] == i.frame for i in record.images)
    figures = view_figures([record])
    assert figures["psnr_db"] is None and figures["ssim"] is None  # it could just repeat the image


def test_without_depth_nothing_of_it_reaches_the_field() -> None:
    field = watched()
    score(Entry("blind", "blind", field), tiny_suite(depth="off"))
    assert not field.seen.depth_m.any() and field.seen.channel is None
    assert field.sampling == tiny_suite().tier.blind
    score(Entry("seeing", "seeing", field), tiny_suite())
    assert field.seen.depth_m.any() and field.sampling == tiny_suite().tier.guided


def test_computed_depth_comes_with_its_spread_and_is_sampled_more_widely() -> None:
    field = watched()
    suite = tiny_suite(depth="computed")
    score(Entry("x", "x", field), suite)
    assert field.seen.depth_sigma_m is not None and field.seen.depth_sigma_m.any()
    assert field.sampling == around_computed(suite.tier.guided)
    room = tiny_room("computed")
    asked, truth = room.asked(room.queries[0]), room.truth[room.queries[0]]
    assert asked.label is None and asked.depth_m is not None and asked.depth_sigma_m is not None
    known = (asked.depth_m > 0) & (truth.depth_m > 0)
    assert known.mean() > 0.5
    assert np.median(np.abs(asked.depth_m - truth.depth_m)[known] / truth.depth_m[known]) < 0.1
    assert not np.array_equal(asked.depth_m, room.frames[room.queries[0]].depth_m)


def test_the_compiled_renderer_gives_the_figures_of_the_field_itself() -> None:
    fast, plain = (score(Entry("x", "x", f), tiny_suite()) for f in (tiny_field(), watched()))
    for query, answer in fast.answers.items():
        other = plain.answers[query].prediction
        np.testing.assert_allclose(answer.prediction.confidence, other.confidence, atol=1e-4)
        assert (answer.prediction.label == other.label).mean() > 0.999


def test_labels_of_another_set_are_compared_by_name() -> None:
    two = make_label_set("two", ["curb", "wall"], ids=[7, 9], ignore_id=255)
    field = tiny_field(two)
    with torch.no_grad():
        field.classifier.weight.zero_()
        field.classifier.bias.copy_(torch.tensor([-9.0, 9.0]))
    room = tiny_room()
    frames = [as_given(room.frames[n], depth=True) for n in (5, 7)]
    query = as_given(room.frames[6], depth=True)
    wall = ROOMS.ids[ROOMS.names.index("wall")]
    found = predict_view(field, frames, query, tiny_suite().tier, ROOMS)
    assert set(np.unique(found.label[found.known])) == {wall}
    with torch.no_grad():
        field.classifier.bias.copy_(torch.tensor([9.0, -9.0]))
    assert set(np.unique(predict_view(field, frames, query, tiny_suite().tier, ROOMS).label)) == {ROOMS.ignore_id}


def test_keyframes_are_no_queries_and_not_next_to_one() -> None:
    chosen = choose_fitted(tiny_room(), tiny_suite())
    assert len(chosen.labelled) == 3 and not set(chosen.labelled) & {5, 6, 7, 8, 9} and not chosen.unlabelled
    with pytest.raises(ConfigError, match="9 keyframes are requested"):
        choose_fitted(tiny_room(), tiny_suite(scene={"keyframes": 9, "guard": 2}))


@pytest.mark.slow
def test_further_frames_take_part_without_their_labels() -> None:
    scene = {"keyframes": 2, "unlabelled": 4, "guard": 1, "seconds": 0, "steps": 2, "shares": (1.0,)}
    suite = tiny_suite(protocol="finetune", scene=scene, views=6)
    chosen = choose_fitted(tiny_room(), suite)
    assert len(chosen.labelled) == 2 and len(chosen.unlabelled) == 4
    assert not {*chosen.labelled, *chosen.unlabelled} & {5, 6, 7, 8, 9} and not set(chosen.labelled) & {
        *chosen.unlabelled
    }
    field = watched()
    answers = answer_from_keyframes(tiny_room(), field, suite, chosen)
    channel = field.seen.channel
    assert channel is not None
    used = list(answers.values())[-1].source_frames
    assert set(used) - set(chosen.labelled), "unlabelled frames are source views"
    for number, labels in zip(used, channel, strict=True):
        assert bool((labels >= 0).any()) == (number in chosen.labelled)
    assert score(tiny_contestant(), suite).record.keyframes == chosen.labelled


def test_fitting_gives_a_curve_and_renders_from_the_labelled_keyframes() -> None:
    suite = tiny_suite(protocol="finetune")
    told: list[float] = []
    record = score(tiny_contestant(), suite, told.append).record
    assert [p.share for p in record.curve] == [0, 0.5, 1.0]
    assert [p.steps for p in record.curve] == [0, 1, 2]
    assert record.curve[-1].confusion == record.confusion
    assert all(set(i.sources) <= set(record.keyframes) for i in record.images)
    assert told == sorted(told) and told[-1] == pytest.approx(1)
    figures = view_figures([record])
    assert [p["steps"] for p in figures["curve"]] == [0, 1, 2]


def test_labels_kept_from_the_queries_play_no_part_in_fitting_either() -> None:
    plain = {"keyframes": 3, "guard": 1, "seconds": 0, "steps": 3, "shares": (1.0,)}
    kept = score(tiny_contestant(), tiny_suite(protocol="finetune", scene={**plain, "labelled_sources": False}))
    given = score(tiny_contestant(), tiny_suite(protocol="finetune", scene=plain))
    assert kept.record.curve[0].confusion != given.record.curve[0].confusion
    for known, suite in ((False, {**plain, "labelled_sources": False}), (True, plain)):
        assert fit_config(tiny_suite(protocol="finetune", scene=suite), 1.0).step.known_labels is known


def test_labels_carried_by_depth_alone_stand_beside_what_was_fitted() -> None:
    suite = tiny_suite(protocol="finetune", scene={"keyframes": 3, "guard": 1, "seconds": 0, "steps": 1})
    record = score(tiny_contestant(), suite).record
    assert record.carried is not None
    metrics = from_rows(record.carried).metrics()
    assert metrics.total_accuracy is not None and metrics.total_accuracy > 0.3
    assert metrics.coverage is not None and metrics.coverage < 1, "nothing where no keyframe looked"
    figures = view_figures([record])
    assert figures["carried_miou"] == metrics.miou
    assert metrics.miou is not None and figures["data_set"]["miou"] is not None
    difference = compare_with_carried([record])
    assert difference is not None
    assert difference["observed"] == pytest.approx(figures["data_set"]["miou"] - metrics.miou)
    last, count = record.calibration.count[-1], sum(record.calibration.count)
    assert figures["sure"] == last / count and (figures["sure_right"] is None) is (last == 0)
    assert score(tiny_contestant(), tiny_suite()).record.carried is None
    blind = {"keyframes": 3, "guard": 1, "seconds": 0, "steps": 1}
    assert score(tiny_contestant(), tiny_suite(protocol="finetune", depth="off", scene=blind)).record.carried is None


def test_scratch_starts_from_random_weights_whatever_the_file_holds() -> None:
    suite = tiny_suite(protocol="scratch")
    first, second = (score(tiny_contestant(seed), suite).record for seed in (0, 1))
    assert first.confusion == second.confusion
    tuned = [score(tiny_contestant(s), tiny_suite(protocol="finetune")).record for s in (0, 1)]
    assert tuned[0].curve[0].confusion != tuned[1].curve[0].confusion
    (without_file,) = load_entries([], ["sray"])
    beside = score(without_file, tiny_suite(protocol="finetune")).record
    assert beside.curve[0].confusion == score(without_file, suite).record.curve[0].confusion  # as from scratch


def test_a_kind_for_one_scene_is_fitted_in_a_box_round_what_the_keyframes_see() -> None:
    suite = tiny_suite(protocol="scratch")
    (entry,) = load_entries([], ["semantic_nerf"])
    result = run_room(tiny_room(), entry, suite)
    assert result is not None
    before, after = (from_rows(point.confusion).metrics() for point in result.record.curve[::2])
    assert before.total_accuracy == 0, "unfitted it knows nothing"
    assert after.total_accuracy > 0
    room = tiny_room()
    views = stack_sources([view_from_frame(room.frames[n], ROOMS, 48) for n in result.record.keyframes])
    box = scene_config(entry.field, views, suite.tier.guided.far_m)
    assert box.half_extent_m < entry.field.config.half_extent_m
    depth_m = max(float(room.frames[n].depth_m.max()) for n in result.record.keyframes)
    assert 0.5 * depth_m < box.half_extent_m


def test_a_fitting_that_is_stopped_gives_no_figures() -> None:
    steps: list[float] = []
    suite = tiny_suite(protocol="finetune", scene={"keyframes": 3, "guard": 1, "seconds": 0, "steps": 50})
    assert run_room(tiny_room(), tiny_contestant(), suite, steps.append, lambda: len(steps) >= 2) is None
    assert len(steps) == 2
