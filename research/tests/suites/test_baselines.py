from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from research.suites.baselines import BASELINES, BaselinePrediction, baseline_predictions
from research.suites.figures import compare_with_baselines, comparison_rows
from research.suites.predict import Prediction, predict_view
from research.suites.protocols import run_room
from research.suites.rooms import as_given
from research.suites.scoring import from_rows, interior_truth
from research.tests.suites.tiny import tiny_contestant, tiny_room, tiny_suite
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import PosedFrame, SourceViews
from tests.small import tiny_field

QUERY, OTHERS = 6, (5, 8, 12)


class Knowing(SRay):
    """An encoder that is right about every image, but for those whose numbers are in ``wrong``."""

    kind = "sray"
    truths: list[np.ndarray]
    wrong: tuple[int, ...] = ()

    def encode(self, views: SourceViews) -> EncodedViews:
        return super().encode(views)

    def source_logits(self, sources: EncodedViews) -> torch.Tensor:
        maps = []
        for i, truth in enumerate(self.truths):
            channel = torch.from_numpy(ROOMS.to_channels(truth, "truth").astype(np.int64)).clamp_min(0)
            if i in self.wrong:
                channel = (channel + 1) % len(ROOMS)
            maps.append(4.0 * torch.nn.functional.one_hot(channel, len(ROOMS)).permute(2, 0, 1).float())
        return torch.stack(maps)


def predictions(wrong: tuple[int, ...] = (), *, depth: bool = True, own_image: bool = True):
    room = tiny_room()
    plain = tiny_field()
    field = Knowing(plain.config, ROOMS).eval()
    field.truths = [room.frames[n].label for n in (*OTHERS, QUERY)]  # type: ignore[misc]
    field.wrong = wrong
    given = [as_given(room.frames[n], depth=depth) for n in OTHERS]
    sensed = [as_given(room.frames[n], depth=True) for n in OTHERS]
    current, truth = as_given(room.frames[QUERY], depth=depth), room.truth[QUERY]
    made = prediction_at(truth.exact_depth_m, given, current)
    return truth, baseline_predictions(
        field, given, sensed, current, made, truth.exact_depth_m, truth.label, ROOMS, own_image=own_image
    )


def prediction_at(depth_m: np.ndarray, given: list[PosedFrame], current: PosedFrame) -> Prediction:
    made = predict_view(tiny_field(), given, current, tiny_suite().tier, ROOMS)
    return replace(made, depth_m=depth_m)


def accuracy(found: BaselinePrediction, truth: np.ndarray) -> float:
    counted = truth != ROOMS.ignore_id
    return float((found.label == truth)[counted].mean())


def test_views_that_are_right_are_right_about_the_query() -> None:
    truth, found = predictions()
    assert tuple(found) == BASELINES
    assert accuracy(found["own"], truth.label) == 1
    assert accuracy(found["vote"], truth.label) > 0.97 and accuracy(found["vote_exact"], truth.label) > 0.97
    assert accuracy(found["oracle"], truth.label) == 1


def test_other_views_outvote_a_wrong_image_of_the_query_where_they_see_it() -> None:
    truth, found = predictions(wrong=(3,))
    assert accuracy(found["own"], truth.label) == 0
    assert accuracy(found["vote_exact"], truth.label) > 0.6
    assert accuracy(found["oracle"], truth.label) > accuracy(found["vote_exact"], truth.label)


def test_the_image_of_the_query_has_no_vote_where_it_is_no_source() -> None:
    truth, found = predictions(wrong=(0, 1, 2), own_image=False)
    assert accuracy(found["own"], truth.label) == 1, "the row is there for comparison"
    assert accuracy(found["vote_exact"], truth.label) < 0.02 and accuracy(found["oracle"], truth.label) < 0.02
    assert not found["vote_exact"].known.all(), "what no other view sees is unknown"
    unknown = ~found["vote_exact"].known
    assert (found["vote_exact"].label[unknown] == ROOMS.ignore_id).all()


def test_without_depth_the_vote_looks_where_the_field_says_the_surface_is() -> None:
    truth, found = predictions(depth=False)
    assert accuracy(found["vote"], truth.label) > 0.9
    _, with_depth = predictions()
    assert (found["vote_exact"].label == with_depth["vote_exact"].label).all()


def test_interior_pixels_are_more_than_two_pixels_from_another_label() -> None:
    label = np.full((12, 12), 3, np.uint8)
    label[:, 6:] = 4
    inner = interior_truth(label, ROOMS.ignore_id)
    assert (inner[:, 4:8] == ROOMS.ignore_id).all()
    assert (inner[:, :4] == 3).all() and (inner[:, 8:] == 4).all()


def test_a_record_holds_the_rows_and_their_differences() -> None:
    entry = tiny_contestant()
    result = run_room(tiny_room(), entry, tiny_suite())
    assert result is not None
    record = result.record
    rows = comparison_rows([record])
    assert tuple(rows) == BASELINES
    assert all(rows["oracle"][key] >= rows["vote_exact"][key] for key in ("miou", "total_accuracy"))  # type: ignore[operator]
    inner, whole = from_rows(record.interior).metrics(), from_rows(record.confusion).metrics()
    assert 0 < inner.pixels < whole.pixels
    assert from_rows(record.rows["own"].interior).metrics().pixels == inner.pixels
    differences = compare_with_baselines([record, record])
    assert set(differences) == set(BASELINES) and differences["own"]["scenes"] == 2
    assert differences["own"]["low"] <= differences["own"]["high"] and differences["own"]["note"] is None
    one = compare_with_baselines([record])["own"]
    assert one["observed"] == pytest.approx(differences["own"]["observed"]) and one["scenes"] == 1
    assert one["mean"] is one["low"] is one["high"] is None and "2 rooms" in one["note"]
    assert compare_with_baselines([]) == {}


@pytest.mark.parametrize("protocol", ["finetune", "scratch"])
def test_fitted_fields_have_no_rows(protocol: str) -> None:
    result = run_room(tiny_room(), tiny_contestant(), tiny_suite(protocol=protocol))
    assert result is not None and not result.record.rows
