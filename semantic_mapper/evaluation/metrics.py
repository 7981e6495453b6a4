"""Segmentation accuracy of images and maps, and whether confidences can be believed.

One implementation for everything the project reports. Rules, the same everywhere:

- Pixels whose truth is the ignore id do not count.
- A prediction of "unknown" (the ignore id) where the truth is known counts as wrong: it lowers the accuracy and the
  IoU of the true class, and raises no other class's union. A method gains nothing by staying silent.
- Means over classes run over the classes that occur in the truth. A class that is only predicted lowers the others
  by the pixels it took from them and adds no term of its own.
- Figures of a data set come from one confusion matrix over all its pixels; means over images (``ImageMeans``) are
  another number and are always named so.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, Float64, UInt8


@dataclass(frozen=True, slots=True)
class SegmentationMetrics:
    """Figures in 0..1; ``None`` where no pixel had a truth."""

    miou: float | None  # mean intersection over union of the classes that occur in the truth
    total_accuracy: float | None  # fraction of the pixels that are right
    average_accuracy: float | None  # mean over the classes in the truth of the fraction of their pixels that is right
    coverage: float | None  # fraction of the pixels with any prediction but "unknown"
    per_class: dict[str, float] = field(default_factory=dict[str, float])  # IoU, in the label set's order
    pixels: int = 0  # how many pixels were counted


_FIGURES = ("miou", "total_accuracy", "average_accuracy", "coverage")


class ConfusionMatrix:
    """Counts of (true class, predicted class) pixels of a label set; adds up over images, frames and processes."""

    def __init__(self, label_set: LabelSet) -> None:
        self.label_set = label_set
        # (L, L + 1) in channel order; row = truth, column = prediction, the last column = predicted "unknown"
        self.counts: NDArray[np.int64] = np.zeros((len(label_set), len(label_set) + 1), np.int64)

    def update(self, truth: UInt8, predicted: UInt8, where: str = "label image") -> None:
        """Count one image, map or batch of uint8 class ids (...) of the label set; ``where`` names it in errors.

        Where the truth has the ignore id nothing is counted; predicted, that means "unknown" and counts as wrong.
        Raises ShapeError: the shapes differ. LabelError: an id is not in the label set.
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

    def __add__(self, other: "ConfusionMatrix") -> "ConfusionMatrix":
        if other.label_set.names != self.label_set.names:
            raise ShapeError(
                f"confusion matrices of different label sets ('{self.label_set.name}' and '{other.label_set.name}') "
                "cannot be added; map the labels with LabelSet.channel_map_from first"
            )
        total = ConfusionMatrix(self.label_set)
        total.counts = self.counts + other.counts
        return total

    def metrics(self) -> SegmentationMetrics:
        """All figures; ``None`` where nothing was counted."""
        pixels = int(self.counts.sum())
        if pixels == 0:
            return SegmentationMetrics(None, None, None, None)
        hits, occurring, union = class_sums(self.counts)
        true = np.flatnonzero(occurring)
        iou = hits[true] / union[true]
        return SegmentationMetrics(
            miou=float(iou.mean()),
            total_accuracy=float(hits.sum() / pixels),
            average_accuracy=float((hits[true] / occurring[true]).mean()),
            coverage=1.0 - float(self.counts[:, -1].sum() / pixels),
            per_class={self.label_set.names[k]: float(value) for k, value in zip(true, iou, strict=True)},
            pixels=pixels,
        )


def confusion_of(truth: UInt8, predicted: UInt8, label_set: LabelSet, where: str = "label image") -> ConfusionMatrix:
    """Confusion matrix of one image; see ``ConfusionMatrix.update``."""
    matrix = ConfusionMatrix(label_set)
    matrix.update(truth, predicted, where)
    return matrix


class ImageMeans:
    """Means over images of each image's own figures; of a class, over the images that show it."""

    def __init__(self) -> None:
        self._sums: Counter[str] = Counter()
        self._class_sums: Counter[str] = Counter()
        self._class_images: Counter[str] = Counter()
        self._images = self._pixels = 0

    def add(self, image: ConfusionMatrix) -> None:
        """Count one more image."""
        m = image.metrics()
        if m.pixels:
            self._images += 1
            self._pixels += m.pixels
            self._sums.update({name: getattr(m, name) for name in _FIGURES})
            self._class_sums.update(m.per_class)
            self._class_images.update(m.per_class.keys())

    def metrics(self) -> SegmentationMetrics:
        """Of the images so far."""
        means = [float(self._sums[name]) / self._images if self._images else None for name in _FIGURES]
        per_class = {name: value / self._class_images[name] for name, value in self._class_sums.items()}
        return SegmentationMetrics(*means, per_class=per_class, pixels=self._pixels)


class ConfidenceScores:
    """Whether confidence means something, over any number of images: of calibration, and of strange things."""

    _BINS, _FINE = 15, 100  # of calibration; fine bins in one of them

    def __init__(self) -> None:
        size = self._BINS * self._FINE
        self._count, self._strange = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self._sum, self._right = np.zeros(size), np.zeros(size)

    def update(self, confidence: Float32, correct: NDArray[np.bool_], strange: NDArray[np.bool_]) -> None:
        """Add confidences (...) in [0, 1] of the predicted class, of pixels that have a truth, and whether it is right.

        ``strange`` pixels, whose truth is a class that cannot be predicted, count for ``open_set_auroc`` alone.
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
    def calibration_error(self) -> float | None:
        """Of the pixels whose class can be predicted, in 15 bins."""
        joined = (of.reshape(self._BINS, self._FINE).sum(1) for of in (self._count, self._sum, self._right))
        return calibration_error(*joined)

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


def calibration_error(count: NDArray[np.int64], confidence_sum: Float64, right: Float64) -> float | None:
    """Expected calibration error, mean over the samples: accuracy of their bin against its confidence; None for none.

    Of bins (B,) of confidence: how many samples, the sum of their confidences, and how many are right.
    """
    total = int(count.sum())
    return float(np.abs(right - confidence_sum).sum() / total) if total else None


def class_sums(counts: NDArray[Any]) -> NDArray[Any]:
    """What IoU needs of confusion matrices, and what adds up: (..., L, L + 1) -> (..., 3, L) hits, truth and union."""
    hits = np.diagonal(counts, axis1=-2, axis2=-1)
    occurring = counts.sum(axis=-1)
    union = occurring + counts[..., :-1].sum(axis=-2) - hits
    return np.stack((hits, occurring, union), axis=-2)
