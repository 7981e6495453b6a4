"""Panoptic quality: how well each pixel's class and object are found (Kirillov et al., 2019).

A segment is a class of stuff in an image, or one object of a class of things. A found segment is right where it has the
class of a true one and overlaps it by more than half of their union, which no second one can. SQ is the mean IoU of the
right ones, RQ their F1 score, and PQ = SQ * RQ, all a class. PQ+ (Porzi et al., 2019, PQ dagger) differs for stuff: the
mean over its true segments of the IoU, without the threshold.

Void in the truth are the ignore id, things whose object is unknown, and segments that are too small. A found segment is
compared without its pixels on void, and is neither right nor wrong where most of it lies there. Found segments that are
too small, and found things without a number, are as if nothing had been found.
"""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.labels import STUFF_NAMES, LabelSet
from semantic_mapper.types import Float64, UInt8

SMALL = 100 / (1408 * 376)  # of an image, as the evaluation of KITTI-360 has it: 100 of its pixels, 6 of 352x94
MATCH_IOU = 0.5
MOSTLY_VOID = 0.5  # of a found segment: more, and it counts as nothing


class PanopticImage(NamedTuple):
    """Class ids (H, W) uint8, and the number (H, W) of each pixel's object, 0 = none; those of stuff do not matter."""

    label: UInt8
    instance: NDArray[np.integer[Any]]


@dataclass(frozen=True, slots=True)
class ClassQuality:
    """Figures of a class in 0..1."""

    pq: float
    sq: float
    rq: float
    pq_plus: float


@dataclass(frozen=True, slots=True)
class PanopticMetrics:
    """Means over the classes that were true or found somewhere, in 0..1; None without such classes."""

    pq: float | None = None  # of all classes, as the next three
    sq: float | None = None
    rq: float | None = None
    pq_plus: float | None = None
    pq_things: float | None = None  # of a part of them, as the next
    pq_stuff: float | None = None
    per_class: dict[str, ClassQuality] = field(default_factory=dict[str, ClassQuality])  # in the label set's order
    segments: int = 0  # true segments


class PanopticCounts:
    """Sums by class of a label set, of which ``stuff`` names those that are no things; they add up over images.

    ``sums`` (5, L): IoU of the right segments; how many are right, wrong, and missed; and the IoU of all true segments
    of stuff with what was found there.
    """

    def __init__(self, label_set: LabelSet, stuff: Collection[str] = STUFF_NAMES) -> None:
        self.label_set = label_set
        self.stuff = frozenset(stuff)
        self.sums: Float64 = np.zeros((5, len(label_set)))
        self._thing = np.array([name not in self.stuff for name in label_set.names])

    def update(self, truth: PanopticImage, found: PanopticImage, where: str = "image") -> None:
        """Count one image.

        Raises ShapeError: the four images differ in shape. LabelError: an id that is not in the label set.
        """
        shapes = [np.shape(image) for image in (*truth, *found)]
        if len(set(shapes)) > 1:
            raise ShapeError(f"{where}: truth, its objects, found and its objects have shapes {shapes}; resize them")
        least = SMALL * truth.label.size
        true, true_of, true_class = self._segments(truth, least, f"{where}: truth")
        seen, seen_of, seen_class = self._segments(found, least, f"{where}: prediction")
        # Row 0 is void in the truth, column 0 where nothing was found.
        pairs = np.bincount(true_of * (len(seen) + 1) + seen_of, minlength=(len(true) + 1) * (len(seen) + 1))
        overlap = pairs.reshape(len(true) + 1, len(seen) + 1)
        hit, on_void = overlap[1:, 1:], overlap[0, 1:]
        union = true[:, None] + (seen - on_void)[None] - hit
        iou = np.where(true_class[:, None] == seen_class[None], hit / np.maximum(union, 1), 0.0)
        match = iou > MATCH_IOU
        right, wrong = match.any(axis=1), ~match.any(axis=0) & (on_void <= MOSTLY_VOID * seen)
        best = np.where(self._thing[true_class], 0.0, iou.max(axis=1, initial=0.0))
        self.sums += (
            self._by_class(true_class, np.where(match, iou, 0.0).sum(axis=1)),
            self._by_class(true_class, right),
            self._by_class(seen_class, wrong),
            self._by_class(true_class, ~right),
            self._by_class(true_class, best),
        )

    def _by_class(self, channel: NDArray[np.int64], values: Any) -> Float64:
        return np.bincount(channel, weights=values, minlength=len(self.label_set)).astype(np.float64)

    def __add__(self, other: "PanopticCounts") -> "PanopticCounts":
        if (other.label_set.names, other.stuff) != (self.label_set.names, self.stuff):
            raise ShapeError(f"panoptic counts of '{self.label_set.name}' and '{other.label_set.name}' cannot be added")
        total = PanopticCounts(self.label_set, self.stuff)
        total.sums = self.sums + other.sums
        return total

    def metrics(self) -> PanopticMetrics:
        """All figures."""
        iou, right, wrong, missed, stuff_iou = self.sums
        true = right + missed
        counted = true + wrong > 0
        if not counted.any():
            return PanopticMetrics()
        rq = right / np.maximum(right + (wrong + missed) / 2, 0.5)
        sq = iou / np.maximum(right, 1)
        pq = sq * rq
        plus = np.where(self._thing, pq, stuff_iou / np.maximum(true, 1))
        values = np.stack((pq, sq, rq, plus))
        named = zip(self.label_set.names, values.T.tolist(), counted, strict=True)
        return PanopticMetrics(
            *values[:, counted].mean(axis=1).tolist(),
            pq_things=_mean(pq[counted & self._thing]),
            pq_stuff=_mean(pq[counted & ~self._thing]),
            per_class={name: ClassQuality(*of) for name, of, here in named if here},
            segments=int(true.sum()),
        )

    def _segments(
        self, image: PanopticImage, least: float, where: str
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Sizes (S,) of the segments, which one from 1 each pixel (H * W,) is in, 0 = none, and channels (S,)."""
        channel = self.label_set.to_channels(image.label, where).ravel()
        thing = np.append(self._thing, False)[channel]  # the last one is of the ignore channel, -1
        number = np.where(thing, np.asarray(image.instance, np.int64).ravel(), 1)
        key = np.where((channel >= 0) & (number > 0), (channel + 1) << 32 | number, 0)
        keys, of, size = np.unique(key, return_inverse=True, return_counts=True)
        kept = (keys > 0) & (size >= least)
        rank = np.where(kept, np.cumsum(kept), 0)
        return size[kept], rank[of.reshape(-1)], (keys[kept] >> 32) - 1


def _mean(values: Float64) -> float | None:
    return float(values.mean()) if len(values) else None
