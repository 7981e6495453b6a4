from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import confusion_matrix, jaccard_score, recall_score

from semantic_mapper.errors import LabelError, ShapeError
from semantic_mapper.evaluation.metrics import (
    ConfidenceScores,
    ConfusionMatrix,
    calibration,
    confusion_of,
    map_confusion,
    map_miou,
    metrics_per_image,
    nearest_labels,
)
from semantic_mapper.labels import SCANNET20, make_label_set

THREE = make_label_set("three", ["wall", "chair", "lamp"], ids=[2, 5, 9], ignore_id=255)


def u8(*values: int) -> np.ndarray:
    return np.array(values, np.uint8)


def test_hand_computed_figures() -> None:
    #             wall wall wall wall chair chair ignore
    truth = u8(2, 2, 2, 2, 5, 5, 255)
    found = u8(2, 2, 5, 9, 5, 2, 2)
    m = confusion_of(truth, found, THREE).metrics()
    # wall: 2 right, union 4 true + 1 chair taken for it; chair: 1 right, union 2 + 1. Lamp is not in the truth.
    assert m.per_class == pytest.approx({"wall": 2 / 5, "chair": 1 / 3})
    assert m.miou == pytest.approx((2 / 5 + 1 / 3) / 2)
    assert m.total_accuracy == pytest.approx(3 / 6)
    assert m.average_accuracy == pytest.approx((2 / 4 + 1 / 2) / 2)
    assert m.coverage == 1
    assert m.pixels == 6


def test_unknown_predictions_count_as_wrong_and_raise_no_union() -> None:
    m = confusion_of(u8(2, 2, 5, 5), u8(2, 255, 5, 255), THREE).metrics()
    assert m.per_class == pytest.approx({"wall": 0.5, "chair": 0.5})
    assert m.total_accuracy == pytest.approx(0.5)
    assert m.coverage == pytest.approx(0.5)


def test_nothing_labelled_gives_no_figures() -> None:
    m = confusion_of(u8(255, 255), u8(2, 5), THREE).metrics()
    assert (m.miou, m.total_accuracy, m.average_accuracy, m.per_class, m.pixels) == (None, None, None, {}, 0)


@given(seed=st.integers(0, 2**32 - 1), classes=st.integers(2, 20), ignored=st.floats(0, 0.6))
def test_agrees_with_scikit_learn_where_pixels_are_ignored(seed: int, classes: int, ignored: float) -> None:
    rng = np.random.default_rng(seed)
    ids = np.array(SCANNET20.ids[:classes], np.uint8)
    truth = rng.choice(ids, (17, 23))
    found = np.where(rng.random(truth.shape) < 0.5, truth, rng.choice(ids, truth.shape))
    truth[rng.random(truth.shape) < ignored] = SCANNET20.ignore_id
    matrix = confusion_of(truth, found, SCANNET20)
    keep = truth != SCANNET20.ignore_id
    y, p = truth[keep], found[keep]
    np.testing.assert_array_equal(matrix.counts[:, :-1], confusion_matrix(y, p, labels=list(SCANNET20.ids)))
    present = sorted({int(i) for i in y})
    m = matrix.metrics()
    assert m.miou == pytest.approx(jaccard_score(y, p, labels=present, average="macro"))
    assert m.average_accuracy == pytest.approx(recall_score(y, p, labels=present, average="macro"))
    assert m.total_accuracy == pytest.approx(float((y == p).mean()))
    each = jaccard_score(y, p, labels=present, average=None)
    assert list(m.per_class.values()) == pytest.approx(list(np.atleast_1d(each)))


def test_data_set_figures_are_those_of_all_pixels_together(rng: np.random.Generator) -> None:
    ids = u8(2, 5, 9, 255)
    truth, found = rng.choice(ids, (4, 6, 5)), rng.choice(ids, (4, 6, 5))
    matrix = ConfusionMatrix(THREE)
    for t, f in zip(truth, found, strict=True):
        matrix.update(t, f)
    assert matrix.metrics() == confusion_of(truth, found, THREE).metrics()
    summed = confusion_of(truth[0], found[0], THREE) + confusion_of(truth[1:], found[1:], THREE)
    np.testing.assert_array_equal(summed.counts, matrix.counts)


def test_per_image_means_differ_from_data_set_figures() -> None:
    small = confusion_of(u8(2), u8(2), THREE)  # one pixel, right
    large = confusion_of(u8(2, 2, 2, 5), u8(5, 5, 5, 5), THREE)  # wall 0, chair 1/4
    empty = confusion_of(u8(255), u8(2), THREE)
    m = metrics_per_image([small, large, empty])
    assert m.miou == pytest.approx((1 + 1 / 8) / 2)
    assert m.total_accuracy == pytest.approx((1 + 1 / 4) / 2)
    assert m.per_class == pytest.approx({"wall": 0.5, "chair": 0.25})
    assert metrics_per_image([]).miou is None


def test_other_shapes_and_foreign_ids_are_refused_by_name() -> None:
    with pytest.raises(ShapeError, match=r"frame 7: truth has shape \(2,\) and the prediction \(1,\)"):
        confusion_of(u8(2, 2), u8(2), THREE, "frame 7")
    with pytest.raises(LabelError, match=r"frame 7: prediction: class ids \[3\]"):
        confusion_of(u8(2), u8(3), THREE, "frame 7")
    with pytest.raises(ShapeError, match="different label sets"):
        ConfusionMatrix(THREE) + ConfusionMatrix(SCANNET20)


def test_nearest_labels_stop_at_the_distance() -> None:
    source = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    asking = np.array([[0.02, 0, 0], [0.97, 0, 0], [0.5, 0, 0]], np.float32)
    found = nearest_labels(asking, source, u8(2, 5), THREE, max_distance_m=0.05)
    np.testing.assert_array_equal(found, u8(2, 5, 255))


def test_an_empty_map_knows_nothing() -> None:
    none = np.zeros((0, 3), np.float32)
    truth = np.zeros((2, 3), np.float32)
    np.testing.assert_array_equal(nearest_labels(truth, none, u8(), THREE), u8(255, 255))
    assert map_miou(truth, u8(2, 5), none, u8(), THREE) == 0
    assert map_miou(truth, u8(255, 255), none, u8(), THREE) is None


def test_holes_in_the_map_cost_as_much_as_wrong_labels() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], np.float32)
    truth = u8(2, 2, 5, 5)
    with_hole = map_confusion(vertices, truth, vertices[:3], truth[:3], THREE).metrics()
    with_error = map_confusion(vertices, truth, vertices, u8(2, 2, 5, 9), THREE).metrics()
    assert with_hole.miou == with_error.miou == pytest.approx(0.75)
    assert with_hole.coverage == pytest.approx(0.75)
    assert map_miou(vertices, truth, vertices, truth, THREE) == 1


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(ShapeError, match="at_xyz"):
        nearest_labels(np.zeros((3, 2), np.float32), np.zeros((1, 3), np.float32), u8(2), THREE)
    with pytest.raises(ShapeError, match="from_label"):
        nearest_labels(np.zeros((3, 3), np.float32), np.zeros((1, 3), np.float32), u8(2, 2), THREE)


def test_calibration_error_by_hand() -> None:
    confidence = np.array([0.9, 0.9, 0.9, 0.9, 0.6, 0.6])
    correct = np.array([True, True, True, False, True, False])
    result = calibration(confidence, correct, bins=10)
    assert result.ece == pytest.approx((4 * 0.15 + 2 * 0.1) / 6)
    assert result.count.sum() == 6
    assert np.isnan(result.accuracy[0])


def test_believable_confidences_have_little_calibration_error(rng: np.random.Generator) -> None:
    p = rng.random(200_000).astype(np.float32)
    correct = rng.random(p.shape) < p
    honest, boasting = calibration(p, correct).ece, calibration(np.sqrt(p), correct).ece
    assert honest is not None and honest < 0.01
    assert boasting == pytest.approx(1 / 6, abs=0.01)  # mean of sqrt(p) - p


def test_confidences_that_are_not_probabilities_are_refused() -> None:
    for bad in (1.5, -0.1, np.nan):
        with pytest.raises(ShapeError, match="probabilities"):
            calibration(np.array([bad]), np.array([True]))
    assert calibration(np.zeros(0), np.zeros(0, bool)).ece is None


def test_confidences_of_several_images_add_up_to_the_calibration_of_all_and_strange_pixels_stay_out():
    draw = np.random.default_rng(3)
    confidence = draw.random((4, 500), np.float32)
    correct = draw.random((4, 500)) < confidence
    strange = draw.random((4, 500)) < 0.2
    scores = ConfidenceScores()
    for row in zip(confidence, correct, strange, strict=True):
        scores.update(*row)
    whole = calibration(confidence[~strange], correct[~strange])
    assert scores.calibration.ece == pytest.approx(whole.ece, abs=1e-9)
    assert np.array_equal(scores.calibration.count, whole.count)


def test_of_pixels_above_a_confidence_it_is_known_how_many_there_are_and_how_many_are_right():
    confidence = np.array([0.95, 0.92, 0.99, 0.9, 0.2, 0.99], np.float32)
    right = np.array([True, False, True, True, True, False])
    scores = ConfidenceScores()
    scores.update(confidence, right, np.arange(6) == 5)
    assert scores.above(0.9) == (3 / 5, 2 / 3)
    assert scores.above(0.995) == (0.0, None) and ConfidenceScores().above(0.9) == (None, None)


def test_open_set_auroc_is_how_often_a_known_pixel_is_surer_than_a_strange_one():
    confidence = np.array([0.9, 0.8, 0.4, 0.6, 0.3], np.float32)
    strange = np.array([False, False, False, True, True])
    scores = ConfidenceScores()
    scores.update(confidence, np.ones(5, bool), strange)
    assert scores.open_set_auroc == pytest.approx(5 / 6)  # 0.4 is below 0.6, all other pairs are in order
    alike = ConfidenceScores()
    alike.update(np.full(4, 0.5, np.float32), np.ones(4, bool), np.array([True, False, True, False]))
    assert alike.open_set_auroc == 0.5
    nothing = ConfidenceScores()
    nothing.update(np.full(2, 0.5, np.float32), np.ones(2, bool), np.zeros(2, bool))
    assert nothing.open_set_auroc is None and nothing.calibration.ece is not None
