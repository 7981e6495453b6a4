"""Average precision of instances, against figures reckoned by hand."""

from __future__ import annotations

import numpy as np
import pytest

from research.evaluation.instances import FoundInstances, average_precision, match_instances
from semantic_mapper.labels import make_label_set

LABELS = make_label_set("things", ["wall", "chair", "cup"])
WALL, CHAIR, CUP = LABELS.ids
STUFF = frozenset(("wall",))


def match(instance: list[int], class_id: list[int], confidence: list[float], truth: list[tuple[int, int]], **options):
    label, number = np.array(truth).T
    found = FoundInstances(np.array(instance), np.array(class_id, np.uint8), np.array(confidence, np.float32))
    return match_instances(found, label.astype(np.uint8), number, LABELS, STUFF, **({"min_voxels": 2} | options))


def test_a_perfect_map_has_all() -> None:
    truth = [(CHAIR, 1)] * 4 + [(CHAIR, 2)] * 4 + [(WALL, 9)] * 4
    figures = average_precision([match([0] * 4 + [1] * 4 + [-1] * 4, [CHAIR, CHAIR], [0.9, 0.8], truth)], LABELS)
    assert figures.ap == figures.recall == figures.precision == 1
    assert (figures.truth, figures.per_class) == (2, {"chair": 1.0})


def test_two_chairs_found_as_one_are_none_or_one() -> None:
    truth = [(CHAIR, 1)] * 4 + [(CHAIR, 2)] * 4
    alike = average_precision([match([0] * 8, [CHAIR], [0.9], truth)], LABELS)
    assert (alike.ap, alike.recall, alike.precision) == (0.5, 0.5, 1), "half of the union is enough"
    mostly = average_precision([match([0] * 10, [CHAIR], [0.9], [(CHAIR, 1)] * 6 + [(CHAIR, 2)] * 4)], LABELS)
    assert (mostly.ap, mostly.recall) == (0.5, 0.5)
    neither = match([0] * 12, [CHAIR], [0.9], [(CHAIR, 1)] * 4 + [(CHAIR, 2)] * 4 + [(CUP, 3)] * 4)
    assert average_precision([neither], LABELS).ap == 0


def test_a_sure_wrong_instance_costs_and_an_unsure_one_costs_nothing() -> None:
    truth = [(CHAIR, 1)] * 4 + [(WALL, 9)] * 4
    sure = average_precision([match([0] * 4 + [1] * 4, [CHAIR, CHAIR], [0.5, 0.9], truth)], LABELS)
    unsure = average_precision([match([0] * 4 + [1] * 4, [CHAIR, CHAIR], [0.5, 0.1], truth)], LABELS)
    assert (sure.ap, unsure.ap) == (0.5, 1.0)
    assert sure.precision == unsure.precision == 0.5


def test_the_second_of_two_halves_is_wrong_and_another_class_is_wrong() -> None:
    truth = [(CHAIR, 1)] * 10
    halves = average_precision([match([0] * 6 + [1] * 4, [CHAIR, CHAIR], [0.9, 0.8], truth)], LABELS)
    assert (halves.ap, halves.precision) == (1, 0.5)
    other = average_precision([match([0] * 10, [CUP], [0.9], truth)], LABELS)
    assert other.ap == other.recall == 0
    assert other.per_class == {"chair": 0.0}


def test_small_true_instances_and_places_without_truth_do_not_count() -> None:
    truth = [(CHAIR, 1)] * 8 + [(CHAIR, 2)] * 3 + [(LABELS.ignore_id, 0)] * 5
    figures = average_precision(
        [match([0] * 8 + [1] * 3 + [2] * 5, [CHAIR] * 3, [0.5, 0.9, 0.9], truth, min_voxels=4)], LABELS
    )
    assert (figures.ap, figures.precision, figures.truth) == (1, 1, 1)


def test_maps_are_ranked_together_and_numbers_of_two_maps_are_two_things() -> None:
    one = match([0] * 4, [CHAIR], [0.9], [(CHAIR, 1)] * 4)
    other = match([0] * 4 + [1] * 4, [CHAIR, CHAIR], [0.5, 0.7], [(CHAIR, 1)] * 4 + [(WALL, 9)] * 4)
    figures = average_precision([one, other], LABELS)
    assert figures.ap == pytest.approx((1 + 2 / 3) / 2)
    assert figures.recall == 1


def test_without_truth_there_is_no_figure() -> None:
    assert average_precision([match([-1] * 4, [], [], [(WALL, 9)] * 4)], LABELS).ap is None
