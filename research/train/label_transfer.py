"""Labels of images from annotated boxes without a fitted field: what a field has to be better than.

*Nearest*: a pixel has the class of the first box that its ray enters. *Box CRF*: the boxes round the pixel's measured
depth vote in equal shares; where several do, or none, the image's own predicted labels decide, smoothed along the
image's edges (mean field with a guided filter, in place of a dense CRF).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.fields.scene.boxes import PrimitiveSet
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import LabelSet
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.types import Float32, Float64, PosedFrame, UInt8

NEAR_M = 0.3

_ROUNDS, _WEIGHT = 5, 2.0  # of the mean field, and of what the neighbours say
_RADIUS, _EPSILON = 0.025, 1e-3  # of the guided filter: fraction of the width, and variance of colours in 0..1
_RIGHT = 0.7  # probability that a predicted label is right
_ELSEWHERE = 1e-3  # share of classes without a box at a pixel that has some


class Transferred(NamedTuple):
    """Ids (H, W) uint8 of the label set, and ids (H, W) of the boxes of things, 0 = none."""

    label: UInt8
    instance: NDArray[np.integer[Any]]


def nearest_labels(frame: PosedFrame, boxes: PrimitiveSet, label_set: LabelSet, missed: str) -> Transferred:
    """The class of the first box along each ray.

    Args:
        frame: Only its camera and pose are looked at.
        boxes: Standing still.
        label_set: Has the classes of all boxes.
        missed: Class of rays that meet no box.
    """
    first = _along_rays(frame, boxes)[:, :1]
    return _labels(_channels(boxes, label_set), boxes, first, label_set.names.index(missed), label_set, frame)


def box_crf(frame: PosedFrame, boxes: PrimitiveSet, predicted: UInt8, label_set: LabelSet) -> Transferred:
    """Boxes at the measured depth, where they agree; the predicted labels elsewhere; smoothed along edges.

    Args:
        frame: With depth.
        boxes: Standing still.
        predicted: (H, W) ids that a network predicted for the image.
        label_set: Has the classes of all boxes.
    """
    height, width = predicted.shape
    channel_of = _channels(boxes, label_set)
    inside, points = _inside(frame, boxes)
    held = np.zeros((height * width, len(label_set)), np.bool_)
    for channel, column in zip(channel_of, inside.T, strict=True):
        held[:, channel] |= column
    share = held / np.maximum(held.sum(axis=1, keepdims=True), 1)
    said = np.full((height * width, len(label_set)), (1 - _RIGHT) / (len(label_set) - 1))
    named = label_set.to_channels(predicted).ravel()
    known = named >= 0
    said[known, named[known]] = _RIGHT
    said[~known] = 1 / len(label_set)
    unary = np.log(said) + np.log(np.where(np.any(inside, axis=1, keepdims=True), share + _ELSEWHERE, 1.0))
    channel = _mean_field(unary.reshape(height, width, -1), frame.rgb).argmax(axis=2).ravel()
    ids = np.array([p.id if p.thing else 0 for p in boxes.primitives])
    centre = np.array([p.T_world_box[:3, 3] for p in boxes.primitives]).reshape(-1, 3)
    instance = np.zeros(height * width, np.int64)
    along = _along_rays(frame, boxes)
    for k in np.unique(channel):
        own = np.flatnonzero((channel_of == k) & (ids > 0))
        here = np.flatnonzero(channel == k)
        if not len(own) or not len(here):
            continue
        far = np.linalg.norm(points[here, None] - centre[own][None], axis=2)
        far[~inside[np.ix_(here, own)]] = np.inf
        at_depth = np.where(np.isfinite(far).any(axis=1), ids[own][far.argmin(axis=1)], 0)
        fits = np.isin(along[here], own)
        on_ray = ids[along[here, fits.argmax(axis=1)]] * fits.any(axis=1)
        instance[here] = np.where(at_depth > 0, at_depth, on_ray)
    return Transferred(label_set.to_ids(channel).reshape(height, width), instance.reshape(height, width))


def _channels(boxes: PrimitiveSet, label_set: LabelSet) -> NDArray[np.int64]:
    return np.array([label_set.names.index(p.class_name) for p in boxes.primitives], np.int64)


def _along_rays(frame: PosedFrame, boxes: PrimitiveSet) -> NDArray[np.int64]:
    """Positions (H * W, M) of the boxes along each pixel's ray, -1 = no more."""
    k, pose = frame.intrinsics, torch.from_numpy(frame.T_world_camera).float()
    rays = pixel_rays(pixel_grid(k.width, k.height), k, pose, near_m=NEAR_M, far_m=np.inf)
    return boxes.intervals(rays).index.numpy()


def _inside(frame: PosedFrame, boxes: PrimitiveSet) -> tuple[NDArray[np.bool_], Float64]:
    """Which pixels' points are inside which box (H * W, P), none without depth; and the points (H * W, 3)."""
    assert frame.depth_m is not None
    depth = frame.depth_m.reshape(-1)
    points = transform(frame.T_world_camera, unproject(frame.depth_m, frame.intrinsics)).reshape(-1, 3)
    inside = np.zeros((len(points), len(boxes)), np.bool_)
    inside[depth > 0] = boxes.inside(points[depth > 0])
    return inside, points


def _labels(
    channel_of: NDArray[np.int64],
    boxes: PrimitiveSet,
    first: NDArray[np.int64],
    missed: int,
    label_set: LabelSet,
    frame: PosedFrame,
) -> Transferred:
    shape = frame.rgb.shape[:2]
    channel = np.append(channel_of, missed)[first[:, 0]]
    ids = np.array([*(p.id if p.thing else 0 for p in boxes.primitives), 0])
    return Transferred(label_set.to_ids(channel).reshape(shape), ids[first[:, 0]].reshape(shape))


def _mean_field(unary: Float64, rgb: UInt8) -> Float32:
    """Probabilities (H, W, L) after some rounds in which neighbours of a like colour agree."""
    guide = rgb.astype(np.float32) / np.float32(255)
    radius = max(2, round(_RADIUS * rgb.shape[1]))
    guided = cv2.ximgproc.createGuidedFilter(guide, radius, _EPSILON)
    probability = _softmax(unary)
    for _ in range(_ROUNDS):
        smooth = [np.asarray(guided.filter(probability[..., k])) for k in range(probability.shape[2])]
        probability = _softmax(unary + _WEIGHT * np.stack(smooth, axis=2))
    return probability


def _softmax(logits: Float64) -> Float32:
    weight = np.exp(logits - logits.max(axis=2, keepdims=True))
    return np.ascontiguousarray(weight / weight.sum(axis=2, keepdims=True), np.float32)
