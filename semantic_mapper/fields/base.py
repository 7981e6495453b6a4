"""The seam that all semantic fields share: encode source views once, render any number of rays from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ShapeError, WeightsError
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

MAX_SOURCE_VIEWS = 16


@dataclass(frozen=True, slots=True, eq=False)
class EncodedViews:
    """Per-view maps of m source views, each independent of the others, so that a keyframe is encoded once.

    Args:
        feature: (m, C, h, w) image features, the F_j of S-Ray Eq. 5.
        rgb: (m, 3, h, w) in [0, 1], at feature resolution.
        geometry: (m, 5, h, w) mixture of logistics along each view ray; see ``sray_layers``.
        K: (m, 3, 3) in pixels of (h, w).
        T_camera_world: (m, 4, 4).
        channel: (m, H, W) int16 known labels at the resolution of the images that were encoded, -1 = none.
    """

    feature: torch.Tensor
    rgb: torch.Tensor
    geometry: torch.Tensor
    K: torch.Tensor
    T_camera_world: torch.Tensor
    channel: torch.Tensor

    def __len__(self) -> int:
        return int(self.feature.shape[0])

    @property
    def size(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of the feature and the label maps; views of one size can be rendered from together."""
        return tuple(self.feature.shape[1:]), tuple(self.channel.shape[1:])

    def select(self, index: torch.Tensor) -> EncodedViews:
        """The views at ``index`` (k,) int64."""
        return EncodedViews(
            self.feature[index],
            self.rgb[index],
            self.geometry[index],
            self.K[index],
            self.T_camera_world[index],
            self.channel[index],
        )


def stack_views(views: Sequence[EncodedViews]) -> EncodedViews:
    """Join encoded views of equal resolution.

    Raises:
        ShapeError: none or too many views, or different resolutions.
    """
    if not 1 <= sum(len(v) for v in views) <= MAX_SOURCE_VIEWS:
        raise ShapeError(f"a render takes 1 to {MAX_SOURCE_VIEWS} source views, got {sum(len(v) for v in views)}")
    sizes = {v.size for v in views}
    if len(sizes) != 1:
        raise ShapeError(f"source views must share one resolution, got {sorted(sizes)}")
    return EncodedViews(
        torch.cat([v.feature for v in views]),
        torch.cat([v.rgb for v in views]),
        torch.cat([v.geometry for v in views]),
        torch.cat([v.K for v in views]),
        torch.cat([v.T_camera_world for v in views]),
        torch.cat([v.channel for v in views]),
    )


class SemanticField(Protocol):
    """What training, finetuning, evaluation and streaming ask of a field."""

    @property
    def label_set(self) -> LabelSet:
        """Classes of the rendered logits, in channel order."""
        ...

    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode source views, each by itself; the result may be cached."""
        ...

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays from encoded source views; differentiable in training."""
        ...


@runtime_checkable
class Sampled(Protocol):
    """A field whose ``render`` draws its samples as a setting says, which may change between two renders."""

    sampling: SamplingConfig


@runtime_checkable
class ImageClassifier(Protocol):
    """A field that may also say what an encoded image shows by itself."""

    def source_logits(self, sources: EncodedViews) -> torch.Tensor | None:
        """Logits (m, L, h, w) of m encoded images; None where the field has no such opinion."""
        ...


def check_classes(field: SemanticField, label_set: LabelSet) -> None:
    """Refuse a field for a map of other classes.

    Raises:
        WeightsError: naming both.
    """
    if field.label_set != label_set:
        raise WeightsError(
            f"the field renders label set '{field.label_set.name}' ({len(field.label_set)} classes), "
            f"the map holds '{label_set.name}' ({len(label_set)}); use weights made for this label set"
        )
