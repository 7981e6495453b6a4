"""Segmentation accuracy of images and maps, and whether confidences can be believed.

One implementation for everything the project reports. Rules, the same everywhere:

- Pixels whose truth is the ignore id do not count.
- A prediction of "unknown" (the ignore id) where the truth is known counts as wrong: it lowers the accuracy and the
  IoU of the true class, and raises no other class's union. A method gains nothing by staying silent.
- Means over classes run over the classes that occur in the truth. A class that is only predicted lowers the others
  by the pixels it took from them and adds no term of its own.
- Figures of a data set come from one confusion matrix over all its pixels; ``metrics_per_image`` are another number
  and are always named so.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, Float64, UInt8


@dataclass(frozen=True, slots=True)
class SegmentationMetrics:
    """Figures in 0..1; ``None`` where no pixel had a truth.

    Args:
        miou: Mean intersection over union of the classes that occur in the truth.
        total_accuracy: Fraction of the pixels that are right.
        average_accuracy: Mean over the classes in the truth of the fraction of their pixels that is right.
        coverage: Fraction of the pixels with any prediction but "unknown".
        per_class: IoU by class name, for the classes that occur in the truth, in the label set's order.
        pixels: How many pixels were counted.
    """

    miou: float | None
    total_accuracy: float | None
    average_accuracy: float | None
    coverage: float | None
    per_class: dict[str, float] = field(default_factory=dict[str, float])
    pixels: int = 0


class ConfusionMatrix:
    """Counts of (true class, predicted class) pixels of a label set; adds up over images, frames and processes.

    Attributes:
        label_set: Whose classes the rows and columns are, in channel order.
        counts: (L, L + 1) int64; row = truth, column = prediction, the last column = predicted "unknown".
    """

    def __init__(self, label_set: LabelSet) -> None:
        self.label_set = label_set
        self.counts: NDArray[np.int64] = np.zeros((len(label_set), len(label_set) + 1), np.int64)

    def update(self, truth: UInt8, predicted: UInt8, where: str = "label image") -> None:
        """Count one image, map or batch.

        Args:
            truth: (...) uint8 class ids of the label set; the ignore id is not counted.
            predicted: (...) uint8 class ids, the same shape; the ignore id means "unknown" and counts as wrong.
            where: Names the image in errors.

        Raises:
            ShapeError: the shapes differ.
            LabelError: an id is not in the label set.
        """
        if truth.shape != predicted.shape:
            raise ShapeError(
                f"{where}: truth has shape {truth.shape} and the prediction {predicted.shape}; resize one of them"
            )
        true_channel = self.label_set.to_channels(truth, f"{where}: truth").ravel()
        channel = self.label_set.to_channels(predicted, f"{where}: prediction").ravel()
        counted = true_channel >= 0
        columns = self.counts.shape[1]
        channel = np.where(channel >= 0, channel, columns - 1)
        cells = true_channel[counted] * columns + channel[counted]
        self.counts += np.bincount(cells, minlength=self.counts.size).reshape(self.counts.shape)

    def __add__(self, other: ConfusionMatrix) -> ConfusionMatrix:
        if other.label_set.names != self.label_set.names:
            raise ShapeError(
                f"confusion matrices of different label sets ('{self.label_set.name}' and '{other.label_set.name}') "
                "cannot be added; map the labels with LabelSet.channel_map_from first"
            )
        total = ConfusionMatrix(self.label_set)
        total.counts = self.counts + other.counts
        return total

    def iou(self) -> Float64:
        """(L,) intersection over union; NaN for a class that does not occur in the truth."""
        hits, occurring = self._hits(), self.counts.sum(axis=1)
        union = occurring + self.counts[:, :-1].sum(axis=0) - hits
        return np.divide(hits, union, out=np.full(len(hits), np.nan), where=occurring > 0)

    def class_accuracy(self) -> Float64:
        """(L,) fraction of each class's pixels that is right; NaN for a class that does not occur in the truth."""
        hits, occurring = self._hits(), self.counts.sum(axis=1)
        return np.divide(hits, occurring, out=np.full(len(hits), np.nan), where=occurring > 0)

    def metrics(self) -> SegmentationMetrics:
        """All figures; ``None`` where nothing was counted."""
        pixels = int(self.counts.sum())
        if pixels == 0:
            return SegmentationMetrics(None, None, None, None)
        iou = self.iou()
        named = zip(self.label_set.names, iou, strict=True)
        return SegmentationMetrics(
            miou=float(np.nanmean(iou)),
            total_accuracy=float(self._hits().sum() / pixels),
            average_accuracy=float(np.nanmean(self.class_accuracy())),
            coverage=1.0 - float(self.counts[:, -1].sum() / pixels),
            per_class={name: float(value) for name, value in named if np.isfinite(value)},
            pixels=pixels,
        )

    def _hits(self) -> Float64:
        return np.diagonal(self.counts).astype(np.float64)


def confusion_of(truth: UInt8, predicted: UInt8, label_set: LabelSet, where: str = "label image") -> ConfusionMatrix:
    """Confusion matrix of one image; see ``ConfusionMatrix.update``."""
    matrix = ConfusionMatrix(label_set)
    matrix.update(truth, predicted, where)
    return matrix


def metrics_per_image(images: Iterable[ConfusionMatrix]) -> SegmentationMetrics:
    """Mean over images of each image's own figures.

    Images without a labelled pixel are left out; a class's figure is the mean over the images that show it.
    """
    means = ImageMeans()
    for image in images:
        means.add(image)
    return means.metrics()


class ImageMeans:
    """``metrics_per_image`` of images that come one by one and are not kept."""

    def __init__(self) -> None:
        self._sums = np.zeros(4)  # of the figures of an image
        self._class_sums: dict[str, float] = {}
        self._class_images: dict[str, int] = {}
        self._images = self._pixels = 0

    def add(self, image: ConfusionMatrix) -> None:
        """Count one more image."""
        m = image.metrics()
        if not m.pixels:
            return
        self._images += 1
        self._pixels += m.pixels
        self._sums += np.array([m.miou, m.total_accuracy, m.average_accuracy, m.coverage], np.float64)
        for name, value in m.per_class.items():
            self._class_sums[name] = self._class_sums.get(name, 0.0) + value
            self._class_images[name] = self._class_images.get(name, 0) + 1

    def metrics(self) -> SegmentationMetrics:
        """Of the images so far."""
        if not self._images:
            return SegmentationMetrics(None, None, None, None)
        means = (float(value) / self._images for value in self._sums)
        per_class = {name: value / self._class_images[name] for name, value in self._class_sums.items()}
        return SegmentationMetrics(*means, per_class=per_class, pixels=self._pixels)


def nearest_labels(
    at_xyz: Float32 | Float64,
    from_xyz: Float32 | Float64,
    from_label: UInt8,
    label_set: LabelSet,
    *,
    max_distance_m: float = 0.05,
) -> UInt8:
    """Carry labels from one set of points to another: each point takes the label of the nearest one.

    Args:
        at_xyz: (N, 3) metres, the points that ask.
        from_xyz: (M, 3) metres, in the same frame; M may be 0.
        from_label: (M,) uint8 class ids.
        label_set: Gives the ignore id.
        max_distance_m: Farther than this there is no answer.

    Returns:
        (N,) uint8 class ids; the ignore id where no point is near enough.

    Raises:
        ShapeError: not (N, 3), or as many labels as points.
    """
    if from_label.shape != (len(from_xyz),):
        raise ShapeError(
            f"from_label: expected shape ({len(from_xyz)},) as from_xyz has points, got {from_label.shape}"
        )
    nearest = nearest_points(at_xyz, from_xyz, max_distance_m=max_distance_m)
    return np.append(from_label, np.uint8(label_set.ignore_id))[nearest]


def nearest_points(
    at_xyz: Float32 | Float64, from_xyz: Float32 | Float64, *, max_distance_m: float = 0.05
) -> NDArray[np.int64]:
    """Which (N,) of M points is nearest to each of N others, (N, 3) and (M, 3) in metres; M = none is near enough.

    Raises:
        ShapeError: not (N, 3).
    """
    for name, xyz in (("at_xyz", at_xyz), ("from_xyz", from_xyz)):
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise ShapeError(f"{name}: expected shape (N, 3), got {xyz.shape}")
    if not len(from_xyz) or not len(at_xyz):
        return np.full(len(at_xyz), len(from_xyz), np.int64)
    from scipy.spatial import KDTree  # a machine that only trains and renders has no SciPy

    _, nearest = KDTree(from_xyz).query(at_xyz, distance_upper_bound=max_distance_m, workers=-1)
    return np.asarray(nearest, np.int64)


def map_confusion(
    truth_xyz: Float32 | Float64,
    truth_label: UInt8,
    map_xyz: Float32 | Float64,
    map_label: UInt8,
    label_set: LabelSet,
    *,
    max_distance_m: float = 0.05,
) -> ConfusionMatrix:
    """Confusion matrix of a map against a labelled mesh: each vertex of the truth asks the nearest map point.

    A vertex that the map does not reach within ``max_distance_m`` counts as "unknown", that is wrong, so holes in the
    map cost as much as wrong labels, and maps of different density are judged at the same places.

    Args:
        truth_xyz, truth_label: (V, 3) vertices in metres and their (V,) uint8 ids; the ignore id is not counted.
        map_xyz, map_label: (N, 3) map points in the same frame and their (N,) uint8 ids.
        label_set: Of both.
        max_distance_m: How far a map point may be from a vertex to speak for it.

    Raises:
        ShapeError, LabelError: as ``nearest_labels`` and ``ConfusionMatrix.update``.
    """
    found = nearest_labels(truth_xyz, map_xyz, map_label, label_set, max_distance_m=max_distance_m)
    return confusion_of(truth_label, found, label_set, "map")


def map_miou(
    truth_xyz: Float32 | Float64,
    truth_label: UInt8,
    map_xyz: Float32 | Float64,
    map_label: UInt8,
    label_set: LabelSet,
    *,
    max_distance_m: float = 0.05,
) -> float | None:
    """mIoU of ``map_confusion``; ``None`` where no vertex has a truth."""
    matrix = map_confusion(truth_xyz, truth_label, map_xyz, map_label, label_set, max_distance_m=max_distance_m)
    return matrix.metrics().miou


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """How confidence and accuracy agree, in bins of equal width.

    Args:
        ece: Expected calibration error: mean over the samples of |accuracy - confidence| of their bin.
        confidence: (B,) mean confidence of each bin, NaN where it is empty.
        accuracy: (B,) fraction of each bin that is right, NaN where it is empty.
        count: (B,) int64 samples of each bin.
    """

    ece: float | None
    confidence: Float64
    accuracy: Float64
    count: NDArray[np.int64]


def calibration(confidence: Float32 | Float64, correct: NDArray[np.bool_], *, bins: int = 15) -> Calibration:
    """Measure whether predictions of confidence p are right in a share p of the cases.

    Args:
        confidence: (...) in [0, 1], of the predicted class; only samples that have a truth.
        correct: (...) bool, the same shape.
        bins: How many bins of equal width; a sample on an edge belongs to the lower one.

    Raises:
        ShapeError: the shapes differ, or a confidence is outside [0, 1] or NaN.
    """
    if confidence.shape != correct.shape:
        raise ShapeError(f"confidence has shape {confidence.shape}, correct {correct.shape}; give one per sample")
    p = confidence.astype(np.float64).ravel()
    if not np.all((p >= 0) & (p <= 1)):
        raise ShapeError("confidence must lie in [0, 1] and hold no NaN; give probabilities, not logits")
    index = np.clip(np.ceil(p * bins).astype(np.int64) - 1, 0, bins - 1)
    count = np.bincount(index, minlength=bins)
    confidence_sum = np.bincount(index, weights=p, minlength=bins).astype(np.float64)
    right = np.bincount(index, weights=correct.ravel(), minlength=bins).astype(np.float64)
    return calibration_of_bins(count, confidence_sum, right)


class ConfidenceScores:
    """Whether confidence means something, over any number of images: calibration, and what it says of strange things.

    Args:
        bins: Of confidence; calibration joins them to 15.
    """

    _BINS = 15
    _FINE = 100  # fine bins in one of calibration

    def __init__(self) -> None:
        size = self._BINS * self._FINE
        self._count, self._strange = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self._sum, self._right = np.zeros(size), np.zeros(size)

    def update(self, confidence: Float32, correct: NDArray[np.bool_], strange: NDArray[np.bool_]) -> None:
        """Add an image.

        Args:
            confidence: (...) in [0, 1], of the predicted class, of pixels that have a truth.
            correct: (...) bool.
            strange: (...) bool, where the truth is a class that cannot be predicted: these count for ``open_set_auroc``
                alone.
        """
        p = np.clip(confidence.astype(np.float64).ravel(), 0, 1)
        size = len(self._count)
        index = np.clip(np.ceil(p * size).astype(np.int64) - 1, 0, size - 1)
        known = ~strange.ravel()
        self._count += np.bincount(index[known], minlength=size)
        self._sum += np.bincount(index[known], weights=p[known], minlength=size)
        self._right += np.bincount(index[known], weights=correct.ravel()[known], minlength=size)
        self._strange += np.bincount(index[~known], minlength=size)

    @property
    def calibration(self) -> Calibration:
        """Of the pixels whose class can be predicted."""

        def joined(values: NDArray[Any]) -> NDArray[Any]:
            return values.reshape(self._BINS, self._FINE).sum(1)

        return calibration_of_bins(joined(self._count), joined(self._sum), joined(self._right))

    def above(self, confidence: float) -> tuple[float | None, float | None]:
        """Fraction of the pixels, of classes that can be predicted, that are surer than this; and how many of those
        are right. None of nothing."""
        first = round(confidence * len(self._count))
        count, total = int(self._count[first:].sum()), int(self._count.sum())
        return count / total if total else None, float(self._right[first:].sum()) / count if count else None

    @property
    def open_set_auroc(self) -> float | None:
        """Probability that a pixel of a class that can be predicted has more confidence than one of another class;
        0.5 = confidence knows nothing of it; None where either is missing."""
        known, strange = int(self._count.sum()), int(self._strange.sum())
        if not known or not strange:
            return None
        below = np.cumsum(self._strange) - self._strange
        return float((self._count * (below + 0.5 * self._strange)).sum() / known / strange)


def calibration_of_bins(count: NDArray[np.int64], confidence_sum: Float64, right: Float64) -> Calibration:
    """Calibration from sums a bin, which add up over images and data sets.

    Args:
        count: (B,) samples of each bin.
        confidence_sum: (B,) sum of their confidences.
        right: (B,) how many of them are right.
    """
    filled = count > 0
    empty = np.full(len(count), np.nan)
    mean_p = np.divide(confidence_sum, count, out=empty.copy(), where=filled)
    accuracy = np.divide(right, count, out=empty.copy(), where=filled)
    total = int(count.sum())
    ece = float((count[filled] * np.abs(accuracy - mean_p)[filled]).sum() / total) if total else None
    return Calibration(ece, mean_p, accuracy, count)
