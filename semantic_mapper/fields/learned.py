"""Fields that have weights, whatever their kind: what training and checkpoints ask of them, and the kinds there are."""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
from abc import ABC, abstractmethod
from importlib import import_module
from typing import Any, ClassVar

import torch
from torch import nn

from semantic_mapper.config import Config, SamplingConfig
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.kinds import field_config, field_kinds
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.fields.volume import sample_from_weights, sample_guided, sample_inverse_depth
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews


class LearnedField(nn.Module, ABC):
    """Base of all fields with weights: what training, finetuning, evaluation and streaming ask of a field.

    A kind of field implements ``encode`` and ``render_samples``; sampling is shared, so that kinds differ in what they
    make of the samples and in nothing else. Kinds that find samples of their own implement ``render`` instead.
    ``config`` is part of every checkpoint; ``sampling`` may be exchanged at any time, no weights depend on it.
    """

    kind: ClassVar[str]
    needs_own_view: ClassVar[bool] = False  # whether it can render only views whose image is among the sources
    holds_scene: ClassVar[bool] = False  # whether its density is the geometry of the one scene that it was fitted to
    knows_classes: ClassVar[bool] = True  # whether it ever says a class; else there is nothing to label or to score
    class_rows: ClassVar[tuple[str, ...]] = ()  # names of the parameters with one row a class, in channel order
    stored_in_half: ClassVar[bool] = False  # whether files hold its weights as float16

    def __init__(self, config: Config, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__()
        self.config: Any = config
        self.sampling = sampling or SamplingConfig()
        self.label_set = label_set

    @property
    def classifies_images(self) -> bool:
        """Whether a field of this kind says anything of single images."""
        return type(self).source_logits is not LearnedField.source_logits

    @property
    def image_encoder(self) -> ImageEncoder | None:
        """The encoder that all kinds with images share; None for kinds without one."""
        return next((module for module in self.modules() if isinstance(module, ImageEncoder)), None)

    @abstractmethod
    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode source views, each by itself; the result may be cached."""

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews
    ) -> tuple[FieldRender, torch.Tensor]:
        """Render rays at given sample depths z (R, N), ascending, metres; also the compositing weights (R, N)."""
        raise NotImplementedError

    def source_logits(self, sources: EncodedViews) -> torch.Tensor | None:
        """Logits (m, L, h, w) of the source images by themselves, for a dense loss; None where a kind has none."""
        return None

    def weigh_own_view(self, factor: float, without_depth: float) -> bool:
        """Let the query's own image count ``factor`` times among the views, ``without_depth`` times on rays without
        measured depth; False = no choice."""
        return False

    def sample(self, rays: RayBatch, sources: EncodedViews) -> torch.Tensor:
        """Sample depths (R, N): coarse + fine, or guided by the depth prior, as ``sampling.mode`` says."""
        if self.sampling.mode == "streaming":
            return sample_guided(rays, self.sampling)
        coarse = sample_inverse_depth(rays.near_m, rays.far_m, self.sampling.coarse)
        with torch.no_grad():
            _, weights = self.render_samples(rays, coarse, sources)
        fine = sample_from_weights(coarse, weights, self.sampling.fine)
        return torch.cat((coarse, fine), dim=1).sort(dim=1).values

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays from encoded source views; differentiable."""
        render, _ = self.render_samples(rays, self.sample(rays, sources), sources)
        return render


def build_field(
    kind: str, config: dict[str, Any] | Config, label_set: LabelSet, sampling: SamplingConfig | None = None
) -> LearnedField:
    """A field with random weights.
    ``config``: of that kind, or plain data for it. Raises ConfigError: no such kind, or a config that does not fit it.
    """
    config = field_config(kind, config)
    _, module, class_name = field_kinds()[kind]
    field_type: type[LearnedField] = getattr(import_module(module), class_name)
    return field_type(config, label_set, sampling)
