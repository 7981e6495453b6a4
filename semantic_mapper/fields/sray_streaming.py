"""S-Ray for streaming: the same weights and the same answer as ``SRay``, rendered by the compiled kernel on the CPU."""

from __future__ import annotations

# torch and safetensors leave parts of their interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from typing import Any

import numpy as np
import torch
from torch import nn

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ConfigError, ShapeError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.sampling import sample_guided
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.sray_kernel import render_rays
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, Float32, RayBatch, SourceViews


def compiled_covers(model: SRay) -> bool:
    """Whether the compiled renderer knows this variant of the model."""
    return model.config.parity == "paper" and not model.config.positional_encoding


class StreamingSRay:
    """Inference-only S-Ray on the CPU. Satisfies ``SemanticField``.

    Args:
        model: Trained field with ``parity="paper"`` and no positional encoding; its weights are copied.
        sampling: Guided sampling round the depth prior.

    Raises:
        ConfigError: a model variant that the compiled kernel does not cover.
    """

    def __init__(self, model: SRay, sampling: SamplingConfig | None = None) -> None:
        if not compiled_covers(model):
            raise ConfigError(
                "the streaming renderer covers parity='paper' without positional encoding; use SRay itself"
            )
        self.model = model
        self.sampling = sampling or SamplingConfig()
        self._weights = pack_weights(model)

    @property
    def label_set(self) -> LabelSet:
        """Classes of the rendered logits, in channel order."""
        return self.model.label_set

    def encode(self, views: SourceViews) -> EncodedViews:
        """As ``SRay.encode``, with maps laid out channels-last so that a sample reads one cache line, not C."""
        with torch.inference_mode():
            encoded = self.model.encode(views)
            return EncodedViews(
                encoded.feature.contiguous(memory_format=torch.channels_last),
                encoded.rgb.contiguous(memory_format=torch.channels_last),
                encoded.geometry.contiguous(memory_format=torch.channels_last),
                encoded.K,
                encoded.T_camera_world,
                encoded.channel,
            )

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays with guided samples; not differentiable."""
        return self.render_samples(rays, sample_guided(rays, self.sampling), sources, self.sampling.least_weight)

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews, least_weight: float = 0.0
    ) -> FieldRender:
        """Render rays at given sample depths z (R, N); see ``SRay.render_samples``.

        Raises:
            ShapeError: fewer than 2 samples a ray.
        """
        if z.shape[1] < 2:
            raise ShapeError(f"a ray needs at least 2 samples for its intervals to have a length, got {z.shape[1]}")
        count, channels = len(z), sources.feature.shape[1]
        # Torch's buffers are aligned alike every time; the matrix product of _classify rounds differently otherwise.
        rendered, colour = torch.empty(count, channels), torch.empty(count, 3)
        depth, opacity, known = torch.empty(count), torch.empty(count), torch.empty(count, dtype=torch.bool)
        carried = torch.empty(count, len(self.label_set))
        config = self.model.config
        keep = 1.0 if config.attention_residual else 0.0
        poses = sources.T_camera_world[:, :3, :]
        maps = torch.cat((sources.feature, sources.rgb), dim=1).permute(0, 2, 3, 1)
        # With the logarithm of the first scale, which is a cue: it is the same for all samples at a pixel.
        geometry = torch.cat((sources.geometry, sources.geometry[:, 1:2].log()), dim=1)
        channel = sources.channel if (sources.channel >= 0).any() else sources.channel[:, :0, :0]
        K = torch.stack((sources.K[:, 0, 0], sources.K[:, 1, 1], sources.K[:, 0, 2], sources.K[:, 1, 2]), dim=1)
        render_rays(
            count,
            (_array(rays.origin), _array(rays.direction), _array(z)),
            (
                _array(maps),
                _array(geometry.permute(0, 2, 3, 1)),
                _array(K),
                _array(poses),
                channel.numpy(),
            ),
            (
                config.heads,
                np.float32(keep),
                np.float32(math.log(1 / config.tau)),
                config.occlusion,
                np.float32(least_weight),
            ),
            self._weights,
            tuple(t.numpy() for t in (rendered, colour, depth, opacity, known, carried)),
        )
        return self._classify(rendered, colour, depth, opacity, known, carried)

    def _classify(
        self,
        rendered: torch.Tensor,
        colour: torch.Tensor,
        depth: torch.Tensor,
        opacity: torch.Tensor,
        known: torch.Tensor,
        carried: torch.Tensor,
    ) -> FieldRender:
        with torch.inference_mode():
            classifier = self.model.classifier
            logits = rendered @ classifier.weight.T + opacity[:, None] * classifier.bias
            if self.model.config.source_labels:
                logits = logits + self.model.label_logit * carried
            logits = logits * known[:, None]
            log_p = torch.log_softmax(logits, dim=-1)
            entropy = -(log_p.exp() * log_p).sum(-1)
        return FieldRender(logits, depth, opacity, colour, entropy, known)


def pack_weights(model: SRay) -> tuple[Any, ...]:
    """Weights as contiguous float32 arrays, grouped as ``sray_kernel.render_rays`` reads them: (in, out), and (out, in)
    of layers with two outputs."""
    off = np.zeros((0, 0), np.float32)
    config = model.config
    radial = (
        (_transposed(model.radial.qkv), _transposed(model.radial.out)) if config.intra_view_attention else (off, off)
    )
    cross = (_transposed(model.cross.qkv), _transposed(model.cross.out)) if config.cross_view_attention else (off, off)
    blend = (*_pair(model.weights.net[0]), *_rows(model.weights.net[2]))
    density = (
        *_pair(model.density.token[0]),
        *_pair(model.density.token[2]),
        _transposed(model.density.qkv),
        *_pair(model.density.out[0]),
        *_rows(model.density.out[2]),
    )
    semantic = (*_pair(model.semantic[0]), *_pair(model.semantic[2]))
    return (radial, cross, blend, density, semantic)


def _array(tensor: torch.Tensor) -> Float32:
    return tensor.detach().float().contiguous().numpy()


def _transposed(layer: nn.Module) -> Float32:
    assert isinstance(layer, nn.Linear)
    return np.ascontiguousarray(layer.weight.detach().float().cpu().numpy().T)


def _pair(layer: nn.Module) -> tuple[Float32, Float32]:
    assert isinstance(layer, nn.Linear)
    return _transposed(layer), np.ascontiguousarray(layer.bias.detach().float().cpu().numpy())


def _rows(layer: nn.Module) -> tuple[Float32, Float32]:
    assert isinstance(layer, nn.Linear)
    return _array(layer.weight), _array(layer.bias)
