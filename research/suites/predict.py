"""Whole query views rendered by any learned field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from research.suites.config import TierConfig
from semantic_mapper.fields.base import Rendered
from semantic_mapper.fields.checkpoint import streamed, streaming
from semantic_mapper.fields.device import DeviceField, to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.render import View, render_image, softmax
from semantic_mapper.fields.sampling import around_computed
from semantic_mapper.fields.sray import SRay
from semantic_mapper.imaging import depth_prior, fill_holes, resize_depth, resize_rgb
from semantic_mapper.labels import IGNORE_CHANNEL, LabelSet
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import Float32, PosedFrame, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A rendered query view.

    Args:
        label: (H, W) uint8 ids of the suite's label set, its ignore id where unknown or where the field's class is not
            among these.
        confidence: (H, W) float32 probability of the field's most likely class.
        rgb: (H, W, 3) float32 in [0, 1].
        depth_m: (H, W) float32.
        known: (H, W) bool.
    """

    label: UInt8
    confidence: Float32
    rgb: Float32
    depth_m: Float32
    known: NDArray[np.bool_]


def predict_view(
    field: LearnedField, sources: Sequence[PosedFrame], query: PosedFrame, tier: TierConfig, label_set: LabelSet
) -> Prediction:
    """Render every pixel of the query view.

    Args:
        field: In evaluation mode, on the device to render on. Its ``sampling`` is set as the tier says.
        sources: What the field may see: depth and labels (ids of the field's label set) only where they are given.
        query: Gives pose, camera and, as the prior of guided sampling, its sensor depth with holes filled; its image
            has a say in that only where it is one of ``sources``. A query without depth is rendered with the tier's
            blind samples.
        tier: Samples and chunk size.
        label_set: Of the answer.
    """
    device = next(field.parameters()).device
    sampling = tier.blind if query.depth_m is None else tier.guided
    if query.depth_sigma_m is not None:
        sampling = around_computed(sampling)
    views = [view_from_frame(frame, field.label_set, query.intrinsics.width) for frame in sources]
    labelled = any(frame.label is not None for frame in sources)
    with torch.inference_mode():
        encoded = field.encode(to_device(stack_sources(views, with_labels=labelled), device))
    field.sampling = sampling
    # The compiled renderer gives the same answer. Exactly this class: a kind derived from it renders in its own way.
    compiled = type(field) is SRay and device.type == "cpu" and sampling.mode == "streaming"
    renderer = streaming(field, sampling) if compiled else DeviceField(field, device, sampling)
    found = streamed(encoded) if compiled else encoded
    depth_m = resize_depth(query, query.intrinsics)
    shown = any(frame is query for frame in sources)
    prior = depth_prior(depth_m, resize_rgb(query, query.intrinsics)) if shown else fill_holes(depth_m)
    scene = (renderer, found, query.intrinsics, query.T_world_camera, prior, sampling, tier.rays_per_chunk)
    render = render_image(View(*scene, measured=depth_m > 0, stamp_ns=query.stamp_ns))
    return _as_prediction(render, field.label_set, label_set, (query.intrinsics.height, query.intrinsics.width))


def _as_prediction(render: Rendered, own_set: LabelSet, label_set: LabelSet, size: tuple[int, int]) -> Prediction:
    probabilities = softmax(render.logits)
    own_ids = own_set.to_ids(np.where(render.known, probabilities.argmax(axis=1), IGNORE_CHANNEL))
    label = label_set.to_ids(label_set.channel_map_from(own_set)[own_ids])
    return Prediction(
        label.reshape(size),
        probabilities.max(axis=1).reshape(size),
        render.rgb.clip(0, 1).reshape(*size, 3),
        render.depth_m.reshape(size),
        render.known.reshape(size),
    )
