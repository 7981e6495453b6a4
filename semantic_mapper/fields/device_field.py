"""A field that renders on a GPU, for callers whose frames and maps live in the machine's own memory."""

from __future__ import annotations

import copy

import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.device import compute_in_bfloat16, to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

# Networks between features and features. Depths, densities and logits stay float32: eight bits of mantissa are 8 mm at
# 2 m, and no camera's pixel.
BFLOAT16_PARTS = ("encoder", "radial", "cross", "semantic")


class DeviceField:
    """Inference-only field on a device. Satisfies ``SemanticField`` and ``Sampled``.

    Weights and the features of keyframes stay on the device; rays are made there, and callers fetch what is rendered,
    a chunk at a time. Sums on a GPU come in no fixed order: its renders repeat but for the last digits.

    Args:
        model: Trained field; it is copied.
        device: Where it computes.
        sampling: Where rays are sampled.
        bfloat16: Let the networks among ``BFLOAT16_PARTS`` compute in bfloat16.
    """

    def __init__(
        self, model: LearnedField, device: torch.device, sampling: SamplingConfig, *, bfloat16: bool = False
    ) -> None:
        self.model = copy.deepcopy(model).to(device).eval()
        self.device = device
        self.sampling = sampling
        torch.backends.cudnn.allow_tf32 = False  # torch's default rounds convolutions to 10 bits, those of depths, too
        if bfloat16:
            parts = dict(self.model.named_children())
            compute_in_bfloat16(self.model, [name for name in BFLOAT16_PARTS if name in parts], device.type)

    @property
    def label_set(self) -> LabelSet:
        """Classes of the rendered logits, in channel order."""
        return self.model.label_set

    @property
    def sampling(self) -> SamplingConfig:
        """Where rays are sampled; may be exchanged between two renders."""
        return self.model.sampling

    @sampling.setter
    def sampling(self, sampling: SamplingConfig) -> None:
        self.model.sampling = sampling

    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode views from anywhere; their features are on the device."""
        with torch.inference_mode():
            return self.model.encode(to_device(views, self.device))

    def source_logits(self, sources: EncodedViews) -> torch.Tensor | None:
        """Logits (m, L, h, w) of the encoded images by themselves, on the device; None where the kind has none."""
        with torch.inference_mode():
            return self.model.source_logits(sources)

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays of the device from views that ``encode`` has encoded; not differentiable."""
        with torch.inference_mode():
            return self.model.render(rays, sources)
