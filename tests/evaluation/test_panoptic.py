"""Panoptic quality against figures reckoned by hand."""

import numpy as np
import pytest

from semantic_mapper.errors import LabelError, ShapeError
from semantic_mapper.evaluation.panoptic import SMALL, PanopticCounts, PanopticImage
from semantic_mapper.labels import make_label_set

LABELS = make_label_set("street", ["road", "car", "cup"], ignore_id=0)
ROAD, CAR, CUP = LABELS.ids
VOID = LABELS.ignore_id
STUFF = ("road",)


def image(*runs: tuple[int, int, int]) -> PanopticImage:
    """One row of pixels from (class id, object, how many)."""
    label = np.concatenate([np.full(n, class_id, np.uint8) for class_id, _, n in runs])[None]
    return PanopticImage(label, np.concatenate([np.full(n, number) for _, number, n in runs])[None])


def metrics(truth: PanopticImage, found: PanopticImage):
    counts = PanopticCounts(LABELS, STUFF)
    counts.update(truth, found)
    return counts.metrics()


def test_the_truth_itself_is_perfect_and_object_numbers_may_be_others() -> None:
    truth, found = image((ROAD, 0, 5), (CAR, 1, 4), (CAR, 2, 3)), image((ROAD, 7, 5), (CAR, 9, 4), (CAR, 1, 3))
    got = metrics(truth, found)
    assert (got.pq, got.sq, got.rq, got.pq_plus, got.pq_things, got.pq_stuff, got.segments) == (1, 1, 1, 1, 1, 1, 3)
    assert list(got.per_class) == ["road", "car"], "classes that are nowhere do not count"


def test_one_of_two_cars_is_found_in_part() -> None:
    # Car 1: 6 of 8 found and nothing else, IoU 0.75; car 2: 1 of 4 found. Road: IoU 8 / 13.
    truth = image((ROAD, 0, 8), (CAR, 1, 8), (CAR, 2, 4))
    found = image((ROAD, 0, 8), (CAR, 1, 6), (ROAD, 0, 2), (CAR, 2, 1), (ROAD, 0, 3))
    got = metrics(truth, found)
    car, road = got.per_class["car"], got.per_class["road"]
    assert (car.sq, car.rq, car.pq) == (0.75, pytest.approx(1 / 2), pytest.approx(0.375))
    assert (road.sq, road.rq, road.pq_plus) == (pytest.approx(8 / 13), 1, pytest.approx(8 / 13))
    assert got.pq == pytest.approx((0.375 + 8 / 13) / 2)
    assert got.sq == pytest.approx((0.75 + 8 / 13) / 2) and got.rq == pytest.approx(0.75)


def test_exactly_half_of_the_union_is_not_enough() -> None:
    got = metrics(image((ROAD, 0, 4), (CAR, 1, 4)), image((ROAD, 0, 2), (VOID, 0, 2), (CAR, 1, 2), (VOID, 0, 2)))
    assert (got.pq, got.per_class["road"].pq_plus, got.per_class["car"].pq_plus, got.pq_plus) == (0, 0.5, 0, 0.25)
    as_one = metrics(image((CAR, 1, 5), (CAR, 2, 5)), image((CAR, 1, 10)))
    assert as_one.pq == 0, "the IoU with each is half"
    as_two = metrics(image((CAR, 1, 10)), image((CAR, 1, 6), (CAR, 2, 4)))
    assert as_two.pq == pytest.approx(0.6 / 1.5)


def test_void_is_not_compared_and_what_lies_mostly_there_is_not_wrong() -> None:
    truth = image((VOID, 0, 6), (CAR, 1, 4), (CAR, 0, 4))  # object 0 of a thing is unknown
    inside = metrics(truth, image((CUP, 1, 6), (CAR, 1, 8)))
    assert (inside.pq, list(inside.per_class)) == (1, ["car"])
    half = metrics(truth, image((VOID, 0, 3), (CUP, 1, 6), (VOID, 0, 5)))
    assert list(half.per_class) == ["car", "cup"], "3 of 6 on void is not most of it"


def test_segments_below_a_hundred_pixels_of_a_kitti_image_are_void() -> None:
    assert 6 <= SMALL * 352 * 94 < 7
    label, instance = np.full((94, 352), ROAD, np.uint8), np.zeros((94, 352), np.uint16)
    label[0, :6], instance[0, :6] = CAR, 1
    label[2, :7], instance[2, :7] = CAR, 2
    truth = PanopticImage(label, instance)
    everywhere = PanopticImage(np.full_like(label, ROAD), np.zeros_like(instance))
    assert metrics(truth, everywhere).per_class["car"].pq == 0
    assert metrics(truth, everywhere).segments == 2, "road and the larger car"
    assert metrics(everywhere, truth).per_class.keys() == {"road", "car"}, "the larger one is wrong, the other nothing"
    assert metrics(everywhere, truth).per_class["road"].rq == 1


def test_images_add_up_and_a_class_is_averaged_over_all_of_them() -> None:
    one, other = PanopticCounts(LABELS, STUFF), PanopticCounts(LABELS, STUFF)
    one.update(image((CAR, 1, 4), (ROAD, 0, 4)), image((CAR, 1, 4), (ROAD, 0, 4)))
    other.update(image((CAR, 1, 4), (ROAD, 0, 4)), image((ROAD, 0, 8)))
    got = (one + other).metrics()
    assert got.per_class["car"].rq == pytest.approx(1 / 1.5)
    assert got.per_class["road"].pq_plus == 0.75
    assert got.per_class["road"].pq == 0.5, "half is not matched: missed and wrong"
    assert PanopticCounts(LABELS).metrics().pq is None


def test_images_of_other_sizes_and_unknown_ids_are_refused() -> None:
    with pytest.raises(ShapeError, match="have shapes"):
        metrics(image((CAR, 1, 4)), image((CAR, 1, 4))._replace(instance=np.zeros((1, 3), np.uint16)))
    with pytest.raises(LabelError):
        metrics(image((CAR, 1, 4)), image((99, 1, 4)))
    with pytest.raises(ShapeError, match="cannot be added"):
        _ = PanopticCounts(LABELS, STUFF) + PanopticCounts(LABELS, ())
