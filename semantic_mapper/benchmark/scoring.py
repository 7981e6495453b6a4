"""From rendered query views to the record of a room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.benchmark.predict import Prediction
from semantic_mapper.benchmark.records import CalibrationRecord, DepthRecord, ImageRecord
from semantic_mapper.benchmark.rooms import BenchmarkRoom
from semantic_mapper.benchmark.views import Sources
from semantic_mapper.evaluation.colour import match_colours, psnr, ssim
from semantic_mapper.evaluation.consistency import Agreement, label_agreement, matching_pixels
from semantic_mapper.evaluation.depth_error import depth_errors
from semantic_mapper.evaluation.metrics import ConfusionMatrix, calibration, confusion_of
from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes import RenderedView
from semantic_mapper.types import Float32


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A rendered query view and what it was rendered from."""

    prediction: Prediction
    sources: Sources
    source_frames: tuple[int, ...]


def image_record(frame: int, answer: Answer, truth: RenderedView) -> ImageRecord:
    """All figures of one view."""
    prediction = answer.prediction
    scores = confusion_of(truth.label, prediction.label, ROOMS, f"query view {frame}").metrics()
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
    )


def room_confusion(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> ConfusionMatrix:
    """One matrix over all query views of a room."""
    total = ConfusionMatrix(ROOMS)
    for frame, answer in answers.items():
        total.update(room.truth[frame].label, answer.prediction.label, f"query view {frame}")
    return total


def room_calibration(room: BenchmarkRoom, answers: Mapping[int, Answer]) -> CalibrationRecord:
    """Confidence against accuracy over the pixels with truth and prediction."""
    confidence: list[Float32] = []
    right: list[np.ndarray] = []
    for frame, answer in answers.items():
        truth, prediction = room.truth[frame].label, answer.prediction
        counted = (truth != ROOMS.ignore_id) & prediction.known
        confidence.append(np.clip(prediction.confidence[counted], 0, 1))
        right.append(prediction.label[counted] == truth[counted])
    return as_calibration(np.concatenate(confidence), np.concatenate(right))


def as_calibration(confidence: Float32, right: NDArray[np.bool_]) -> CalibrationRecord:
    """Sums by bin of the confidence (N,) of answers that are right or not (N,)."""
    found = calibration(confidence, right)
    count = found.count.astype(np.float64)
    return CalibrationRecord(
        count=tuple(int(n) for n in found.count),
        confidence=tuple(float(x) for x in np.nan_to_num(found.confidence) * count),
        right=tuple(float(x) for x in np.nan_to_num(found.accuracy) * count),
    )


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
        same &= truth_a.label.ravel()[index_a] != ROOMS.ignore_id
        labels = answers[a].prediction.label, answers[b].prediction.label
        total += label_agreement(*labels, (index_a[same], index_b[same]), ROOMS.ignore_id)
    return total


def as_rows(confusion: ConfusionMatrix) -> tuple[tuple[int, ...], ...]:
    """Counts as plain data."""
    return tuple(tuple(int(n) for n in row) for row in confusion.counts)


def from_rows(rows: Sequence[Sequence[int]]) -> ConfusionMatrix:
    """The reverse of ``as_rows``."""
    matrix = ConfusionMatrix(ROOMS)
    matrix.counts = np.array(rows, np.int64).reshape(matrix.counts.shape)
    return matrix
