"""What the source views of a query say each by itself, and together without any learned fusion.

Each source view is classified by the field's own encoder and classifier (``source_logits``). These rows stand beside
the field's own in every table:

- ``own``: the query's own image alone.
- ``vote``: mean of the views' log probabilities at the surface, from the inputs that the field has: the given depth of
  the query, the field's rendered depth where it is given none; views that see another surface do not count.
- ``vote_exact``: the same at the exact depth of the query, with sensor depth deciding what a view sees.
- ``oracle``: right wherever any of the views of ``vote_exact`` is right. No fusion of labels can be better.
"""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from research.suites.predict import Prediction
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.geometry import invert_pose, transform, unproject, visible_points
from semantic_mapper.imaging import depth_prior, fill_holes
from semantic_mapper.labels import IGNORE_CHANNEL, LabelSet
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

BASELINES = ("own", "vote", "vote_exact", "oracle")

_Sets = tuple[LabelSet, LabelSet]  # of the field, and of the suite


@dataclass(frozen=True, slots=True, eq=False)
class BaselinePrediction:
    """What a baseline says of a query view.

    Args:
        label: (H, W) uint8 ids of the suite's label set, its ignore id where unknown.
        confidence: (H, W) float32, of the label.
        known: (H, W) bool.
    """

    label: UInt8
    confidence: Float32
    known: NDArray[np.bool_]


def baseline_predictions(
    field: LearnedField,
    sources: Sequence[PosedFrame],
    sensed: Sequence[PosedFrame],
    current: PosedFrame,
    prediction: Prediction,
    exact_depth_m: Float32,
    truth: UInt8,
    label_set: LabelSet,
    *,
    own_image: bool,
) -> dict[str, BaselinePrediction]:
    """All of ``BASELINES`` by name; empty for a field that does not classify single images.

    Args:
        field: In evaluation mode.
        sources: Source views as the field was given them, without the query's own image.
        sensed: The same with the sensor's depth.
        current: The query's own image as the field was given it.
        prediction: What the field made of it: its depth is used where ``current`` has none.
        exact_depth_m: (H, W) of the query view.
        truth: (H, W) ids of ``label_set``, for the oracle.
        label_set: Of the answers.
        own_image: Whether the query's own image has a vote.
    """
    log_p = _log_probabilities(field, [*sources, current])
    if log_p is None:
        return {}
    size, sets = truth.shape, (field.label_set, label_set)
    own = functional.interpolate(log_p[-1:], size=size, mode="bilinear", align_corners=False)
    own = torch.log_softmax(own[0].permute(1, 2, 0).reshape(-1, own.shape[1]), dim=-1).numpy()
    if current.depth_m is None:
        given_m = prediction.depth_m
    else:  # the very depth prior that the field has, or its lead would be the prior's
        given_m = depth_prior(current.depth_m, current.rgb) if own_image else fill_holes(current.depth_m)
    everywhere = np.ones(own.shape[0], bool)
    found = {"own": _as_prediction(own, everywhere, sets, size)}
    votes: dict[str, tuple[Float32, NDArray[np.bool_]]] = {}
    for name, frames, depth_m in (("vote", sources, given_m), ("vote_exact", sensed, exact_depth_m)):
        said, seen = _opinions(log_p[:-1], frames, current, depth_m)
        if own_image:
            said, seen = np.concatenate([said, own[None]]), np.concatenate([seen, everywhere[None]])
        votes[name] = said, seen
        mean = (said * seen[..., None]).sum(0) / np.maximum(seen.sum(0), 1)[:, None]
        found[name] = _as_prediction(mean, np.asarray(seen.any(0)), sets, size)
    found["oracle"] = _oracle(*votes["vote_exact"], found["vote_exact"], truth, sets)
    return found


def _log_probabilities(field: LearnedField, frames: Sequence[PosedFrame]) -> torch.Tensor | None:
    """(m, L, h, w) of each image by itself; None where the field does not classify images."""
    device = next(field.parameters()).device
    width = frames[-1].intrinsics.width
    views = stack_sources([view_from_frame(frame, field.label_set, width) for frame in frames], with_labels=False)
    with torch.inference_mode():
        logits = field.source_logits(field.encode(to_device(views, device)))
        return None if logits is None else torch.log_softmax(logits.float(), dim=1).cpu().clone()


def _opinions(
    log_p: torch.Tensor, frames: Sequence[PosedFrame], current: PosedFrame, depth_m: Float32
) -> tuple[Float32, NDArray[np.bool_]]:
    """What each view says of each query pixel (m, P, L), and whether it sees it (m, P).

    Args:
        log_p: (m, L, h, w) of the views.
        frames: The m views; a view without depth hides nothing.
        depth_m: (H, W) of the query, 0 = unknown.
    """
    points = transform(current.T_world_camera, unproject(depth_m, current.intrinsics).reshape(-1, 3))
    known = depth_m.ravel() > 0
    said = np.empty((len(frames), len(points), log_p.shape[1]), np.float32)
    seen = np.zeros((len(frames), len(points)), bool)
    for i, frame in enumerate(frames):
        grid = torch.from_numpy(_normalised(points, frame.T_world_camera, frame.intrinsics))
        at = functional.grid_sample(
            log_p[i : i + 1], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
        )
        said[i] = torch.log_softmax(at[0, :, 0].T, dim=-1).numpy()
        shape = (frame.intrinsics.height, frame.intrinsics.width)
        view_depth = np.zeros(shape, np.float32) if frame.depth_m is None else frame.depth_m
        seen[i] = known & visible_points(points, frame.T_world_camera, frame.intrinsics, view_depth, measured=True)
    return said, seen


def _normalised(points: Float64, T_world_camera: Float64, intrinsics: CameraIntrinsics) -> Float32:
    """World points (P, 3) as places in the view's image (P, 2), -1 to 1 from edge to edge."""
    p = transform(invert_pose(T_world_camera), points)
    z = np.maximum(p[:, 2], 1e-6)
    u = intrinsics.fx * p[:, 0] / z + intrinsics.cx
    v = intrinsics.fy * p[:, 1] / z + intrinsics.cy
    x, y = 2 * (u + 0.5) / intrinsics.width - 1, 2 * (v + 0.5) / intrinsics.height - 1
    return np.clip(np.stack([x, y], axis=1), -2, 2).astype(np.float32)


def _as_prediction(log_p: Float32, known: NDArray[np.bool_], sets: _Sets, size: tuple[int, ...]) -> BaselinePrediction:
    p = np.exp(log_p - log_p.max(1, keepdims=True))
    confidence = (p.max(1) / p.sum(1)).astype(np.float32)
    label = _suite_ids(np.where(known, log_p.argmax(1), IGNORE_CHANNEL), sets)
    return BaselinePrediction(label.reshape(size), confidence.reshape(size), known.reshape(size))


def _oracle(
    said: Float32, seen: NDArray[np.bool_], vote: BaselinePrediction, truth: UInt8, sets: _Sets
) -> BaselinePrediction:
    right = seen & (_suite_ids(said.argmax(2), sets) == truth.ravel()) & (truth.ravel() != sets[1].ignore_id)
    any_right = right.any(0).reshape(truth.shape)
    best = np.where(right, np.exp(said.max(2)), 0).max(0).reshape(truth.shape).astype(np.float32)
    label = np.where(any_right, truth, vote.label).astype(np.uint8)
    return BaselinePrediction(label, np.where(any_right, best, vote.confidence), vote.known)


def _suite_ids(channel: NDArray[np.integer], sets: _Sets) -> UInt8:
    own, suite = sets
    return suite.to_ids(suite.channel_map_from(own)[own.to_ids(channel.astype(np.int64))])
