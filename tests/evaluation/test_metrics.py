import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import confusion_matrix, jaccard_score, recall_score

from semantic_mapper.errors import LabelError, ShapeError
from semantic_mapper.evaluation.metrics import ConfidenceScores, ConfusionMatrix, ImageMeans, confusion_of
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


def test_unknown_predictions_count_as_wrong_and_raise_no_union_and_nothing_labelled_gives_no_figures() -> None:
    m = confusion_of(u8(2, 2, 5, 5), u8(2, 255, 5, 255), THREE).metrics()
    assert m.per_class == pytest.approx({"wall": 0.5, "chair": 0.5}) and m.total_accuracy == m.coverage == 0.5
    m = confusion_of(u8(255, 255), u8(2, 5), THREE).metrics()
    assert (m.miou, m.total_accuracy, m.average_accuracy, m.per_class, m.pixels) == (None, None, None, {}, 0)


@given(seed=st.integers(0, 2**32 - 1), classes=st.integers(2, 20), ignored=st.floats(0, 0.6))
def test_agrees_with_scikit_learn_where_pixels_are_ignored(seed: int, classes: int, ignored: float) -> None:
    rng = np.random.default_rng(seed)
    ids = np.array(SCANNET20.ids[:classes], np.uint8)
    truth = rng.choice(ids, (17, 23))
    found = np.where(rng.random(truth.shape) < 0.5, truth, rng.choice(ids, truth.shape))
    truth[rng.random(truth.shape) < ignored] = SCANNET20.ignore_id
    matrix = confusion_of(truth[:5], found[:5], SCANNET20) + confusion_of(truth[5:], found[5:], SCANNET20)
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


def test_per_image_means_differ_from_data_set_figures() -> None:
    small = confusion_of(u8(2), u8(2), THREE)  # one pixel, right
    large = confusion_of(u8(2, 2, 2, 5), u8(5, 5, 5, 5), THREE)  # wall 0, chair 1/4
    empty = confusion_of(u8(255), u8(2), THREE)
    means = ImageMeans()
    assert means.metrics().miou is None
    for image in (small, large, empty):
        means.add(image)
    m = means.metrics()
    assert m.miou == pytest.approx((1 + 1 / 8) / 2)
    assert m.total_accuracy == pytest.approx((1 + 1 / 4) / 2)
    assert m.per_class == pytest.approx({"wall": 0.5, "chair": 0.25})


def test_other_shapes_and_foreign_ids_are_refused_by_name() -> None:
    with pytest.raises(ShapeError, match=r"frame 7: truth has shape \(2,\) and the prediction \(1,\)"):
        confusion_of(u8(2, 2), u8(2), THREE, "frame 7")
    with pytest.raises(LabelError, match=r"frame 7: prediction: class ids \[3\]"):
        confusion_of(u8(2), u8(3), THREE, "frame 7")
    with pytest.raises(ShapeError, match="different label sets"):
        ConfusionMatrix(THREE) + ConfusionMatrix(SCANNET20)


@pytest.mark.parametrize("boast", [False, True])
def test_calibration_error_is_the_distance_of_confidence_from_accuracy(rng: np.random.Generator, boast: bool) -> None:
    p = rng.random(200_000).astype(np.float32)
    correct = rng.random(p.shape) < p
    scores = ConfidenceScores()
    for part in np.array_split(np.arange(len(p)), 3):  # images add up
        confidence = np.sqrt(p[part]) if boast else p[part]
        strange = np.arange(len(part)) % 7 == 0
        scores.update(confidence, correct[part] & ~strange, strange)
    expected = 1 / 6 if boast else 0  # mean of sqrt(p) - p
    assert scores.calibration_error == pytest.approx(expected, abs=0.01)


def test_confidence_tells_how_many_pixels_are_sure_and_right_and_apart_from_strange_ones():
    scores = ConfidenceScores()
    confidence = np.array([0.95, 0.92, 0.99, 0.9, 0.2, 0.99], np.float32)
    scores.update(confidence, np.array([True, False, True, True, True, False]), np.arange(6) == 5)
    assert scores.above(0.9) == (3 / 5, 2 / 3)
    assert scores.above(0.995) == (0.0, None) and ConfidenceScores().above(0.9) == (None, None)
    for confidence, strange, auroc in (
        ([0.9, 0.8, 0.4, 0.6, 0.3], [False, False, False, True, True], 5 / 6),  # 0.4 is below 0.6, others are in order
        ([0.5] * 4, [True, False, True, False], 0.5),
        ([0.5] * 2, [False] * 2, None),
    ):
        scores = ConfidenceScores()
        scores.update(np.array(confidence, np.float32), np.ones(len(strange), bool), np.array(strange))
        assert scores.open_set_auroc == (None if auroc is None else pytest.approx(auroc))
