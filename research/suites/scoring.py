"""From rendered query views to the record of a room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from research.evaluation.colour import match_colours, psnr, ssim
from research.evaluation.consistency import Agreement, label_agreement, matching_pixels
from research.evaluation.depth_error import depth_errors
from research.scenes import RenderedView
from research.scenes.suite import ROOMS_SUITE
from research.suites.baselines import BaselinePrediction
from research.suites.predict import Prediction
from research.suites.records import (
    BaselineRecord,
    CalibrationRecord,
    DepthRecord,
    ImageRecord,
    PanopticRecord,
)
from research.suites.rooms import BenchmarkRoom
from research.suites.views import Sources
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.evaluation.panoptic import PanopticCounts
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, UInt8

CONFIDENCE_BINS = 15
BORDER_PX = 2  # pixels at most this far from another label are not interior


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A rendered query view and what it was rendered from; ``baselines`` by name, where the field has any."""

    prediction: Prediction
    sources: Sources
    source_frames: tuple[int, ...]
    condition: str = "clean"
    baselines: Mapping[str, BaselinePrediction] = field(default_factory=dict[str, BaselinePrediction])


def image_record(frame: int, answer: Answer, truth: RenderedView, label_set: LabelSet) -> ImageRecord:
    """All figures of one view."""
    prediction = answer.prediction
    scores = confusion_of(truth.label, prediction.label, label_set, f"query view {frame}").metrics()
    depth = depth_errors(truth.depth_m, prediction.depth_m, prediction.known & (prediction.depth_m > 0))
    was_shown = frame in answer.source_frames
    colour = np.divide(truth.rgb, 255, dtype=np.float32)
    rendered = match_colours(colour, prediction.rgb)
    return ImageRecord(
        frame=frame,
        sources=answer.source_frames,
        baseline_m=answer.sources.distance_m,
        seen=answer.sources.seen,
        miou=scores.miou,
        total_accuracy=scores.total_accuracy,
        average_accuracy=scores.average_accuracy,
        coverage=scores.coverage,
        psnr_db=None if was_shown else psnr(colour, rendered),
        ssim=None if was_shown else ssim(colour, rendered),
        depth=DepthRecord(relative_sum=depth.relative_sum, square_sum=depth.square_sum, count=depth.count),
        condition=answer.condition,
    )


def interior_truth(label: UInt8, ignore_id: int) -> UInt8:
    """True ids (H, W) with the ignore id wherever another label is at most ``BORDER_PX`` away."""
    window = np.ones((2 * BORDER_PX + 1, 2 * BORDER_PX + 1), np.uint8)
    same = cv2.dilate(label, window) == cv2.erode(label, window)
    return np.where(same, label, np.uint8(ignore_id))


def room_confusion(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> ConfusionMatrix:
    """One matrix over all query views of a room."""
    return _confusion(room, {frame: answer.prediction for frame, answer in answers.items()}, interior=False)


def room_interior(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> ConfusionMatrix:
    """The same over the pixels that are not near a border between labels."""
    return _confusion(room, {frame: answer.prediction for frame, answer in answers.items()}, interior=True)


def room_rows(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> dict[str, BaselineRecord]:
    """What the baselines say of all query views of a room, by name."""
    names = next(iter(answers.values())).baselines if answers else {}
    found: dict[str, BaselineRecord] = {}
    for name in names:
        predictions = {frame: answer.baselines[name] for frame, answer in answers.items()}
        found[name] = BaselineRecord(
            confusion=as_rows(_confusion(room, predictions, interior=False)),
            interior=as_rows(_confusion(room, predictions, interior=True)),
            calibration=_calibration(room, predictions),
        )
    return found


def room_calibration(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> CalibrationRecord:
    """Confidence against accuracy over the pixels with truth and prediction."""
    return _calibration(room, {frame: answer.prediction for frame, answer in answers.items()})


def _confusion(
    room: BenchmarkRoom, predictions: Mapping[int, Prediction | BaselinePrediction], *, interior: bool
) -> ConfusionMatrix:
    total = ConfusionMatrix(room.label_set)
    for frame, prediction in predictions.items():
        truth = room.truth[frame].label
        total.update(
            interior_truth(truth, room.label_set.ignore_id) if interior else truth,
            prediction.label,
            f"query view {frame}",
        )
    return total


def _calibration(room: BenchmarkRoom, predictions: Mapping[int, Prediction | BaselinePrediction]) -> CalibrationRecord:
    confidence: list[Float32] = []
    right: list[np.ndarray] = []
    for frame, prediction in predictions.items():
        truth = room.truth[frame].label
        counted = (truth != room.label_set.ignore_id) & prediction.known
        confidence.append(np.clip(prediction.confidence[counted], 0, 1))
        right.append(prediction.label[counted] == truth[counted])
    return as_calibration(np.concatenate(confidence), np.concatenate(right))


def as_calibration(confidence: Float32, right: NDArray[np.bool_]) -> CalibrationRecord:
    """Sums by bin of the confidence (N,) of answers that are right or not (N,)."""
    index = np.clip(np.ceil(confidence.astype(np.float64) * CONFIDENCE_BINS).astype(np.int64) - 1, 0, None)
    sums = (np.bincount(index, weights, CONFIDENCE_BINS).tolist() for weights in (None, confidence, right))
    count, of_confidence, of_right = map(tuple, sums)
    return CalibrationRecord(count=count, confidence=of_confidence, right=of_right)


def room_agreement(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> Agreement:
    """Whether neighbouring query views say the same of what both see, where their true labels say the same."""
    total = Agreement()
    for a, b in room.pairs:
        poses = room.frames[a].T_world_camera, room.frames[b].T_world_camera
        truth_a, truth_b = room.truth[a], room.truth[b]
        index_a, index_b = matching_pixels(
            truth_a.depth_m, poses[0], truth_b.depth_m, poses[1], room.frames[a].intrinsics
        )
        # Rounding to pixels carries some pixels across an object's outline; that is no fault of the field.
        same = truth_a.label.ravel()[index_a] == truth_b.label.ravel()[index_b]
        same &= truth_a.label.ravel()[index_a] != room.label_set.ignore_id
        labels = answers[a].prediction.label, answers[b].prediction.label
        total += label_agreement(*labels, (index_a[same], index_b[same]), room.label_set.ignore_id)
    return total


def as_rows(confusion: ConfusionMatrix) -> tuple[tuple[int, ...], ...]:
    """Counts as plain data."""
    return tuple(tuple(int(n) for n in row) for row in confusion.counts)


def as_panoptic(counts: PanopticCounts) -> PanopticRecord:
    """Sums as plain data."""
    return PanopticRecord(sums=tuple(tuple(row) for row in counts.sums.tolist()))


def as_counts(record: PanopticRecord) -> PanopticCounts:
    """The reverse of ``as_panoptic``."""
    counts = PanopticCounts(ROOMS_SUITE.label_set)
    counts.sums = np.array(record.sums, np.float64).reshape(counts.sums.shape)
    return counts


def from_rows(rows: Sequence[Sequence[int]], label_set: LabelSet = ROOMS_SUITE.label_set) -> ConfusionMatrix:
    """The reverse of ``as_rows``."""
    matrix = ConfusionMatrix(label_set)
    matrix.counts = np.array(rows, np.int64).reshape(matrix.counts.shape)
    return matrix
