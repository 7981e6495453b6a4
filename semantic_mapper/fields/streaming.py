"""S-Ray for streaming: the same weights and the same answer as ``SRay``, rendered by the compiled kernel on the CPU."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import GEOMETRY_CHANNELS, MIN_DEPTH_M, EncodedViews
from semantic_mapper.fields.sray import (
    BACKGROUND_M,
    COLOUR_SCALE,
    HIDDEN,
    LABEL_UNCERTAINTY,
    LEAST_VISIBILITY,
    OWN_DENSITY_OFFSET,
    OWN_RADIUS_M,
    TAU,
    MultiHeadAttention,
    SRay,
)
from semantic_mapper.fields.volume import field_render, sample_guided
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, Float32, RayBatch, SourceViews


class StreamingSRay:
    """Inference-only S-Ray on the CPU. Satisfies ``SemanticField``.
    ``model``: trained field; its weights are copied. ``sampling``: guided sampling round the depth prior."""

    def __init__(self, model: SRay, sampling: SamplingConfig | None = None) -> None:
        self.model = model
        self.sampling = sampling or SamplingConfig()
        self._weights = _pack_weights(model)
        self._settings = _Settings(model.config.heads, model.at_surface, COLOUR_SCALE if model.at_surface else 0.0)

    @property
    def label_set(self) -> LabelSet:
        """Classes of the rendered logits, in channel order."""
        return self.model.label_set

    def encode(self, views: SourceViews) -> EncodedViews:
        """As ``SRay.encode``, with maps laid out channels-last so that a sample reads one cache line, not C."""
        with torch.inference_mode():
            encoded = self.model.encode(views)
            maps = {"feature": encoded.feature, "rgb": encoded.rgb, "geometry": encoded.geometry}
            return replace(
                encoded, **{name: m.contiguous(memory_format=torch.channels_last) for name, m in maps.items()}
            )

    def source_logits(self, sources: EncodedViews) -> torch.Tensor:
        """Logits (m, L, h, w) of the encoded images by themselves."""
        with torch.inference_mode():
            return self.model.source_logits(sources)

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays with guided samples; not differentiable."""
        return self.render_samples(
            rays, sample_guided(rays, self.sampling), sources, self.sampling.sample_weight_threshold
        )

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews, sample_weight_threshold: float = 0.0
    ) -> FieldRender:
        """Render rays at given sample depths z (R, N); see ``SRay.render_samples``.
        Raises ShapeError: fewer than 2 samples a ray."""
        if z.shape[1] < 2:
            raise ShapeError(f"a ray needs at least 2 samples for its intervals to have a length, got {z.shape[1]}")
        count, channels = len(z), self.model.config.feature_dim
        expect_shape(rays.origin, f"{count} 3", "ray origins")
        expect_shape(rays.direction, f"{count} 3", "ray directions")
        # Torch's buffers are aligned alike every time; the product with the classifier rounds differently otherwise.
        rendered, colour = torch.empty(count, channels), torch.empty(count, 3)
        depth, opacity, known = torch.empty(count), torch.empty(count), torch.empty(count, dtype=torch.bool)
        carried = torch.empty(count, len(self.label_set))
        render_sray(
            count,
            _Rays(_array(rays.origin), _array(rays.direction), _array(z), _array(self.model.own_view_factors(rays))),
            _source_maps(sources, channels),
            self._settings._replace(sample_weight_threshold=sample_weight_threshold),
            self._weights,
            _Rendered(*(t.numpy() for t in (rendered, colour, depth, opacity, known, carried))),
        )
        with torch.inference_mode():
            classifier = self.model.classifier
            sum_of_weights = 1.0 if self.model.at_surface else opacity[:, None]
            logits = rendered @ classifier.weight.T + sum_of_weights * classifier.bias
            logits = logits + self.model.label_logit * carried
            return field_render(logits=logits, depth_m=depth, opacity=opacity, rgb=colour, known=known)


class _Rays(NamedTuple):
    origin: Float32  # (R, 3)
    direction: Float32  # (R, 3)
    z: Float32  # (R, N) ascending
    own_factor: Float32  # (R,) times which the own view's weight counts, of tokens at the surface


class _SourceMaps(NamedTuple):
    feature: Float32  # (m, h, w, C)
    rgb: Float32  # (m, h, w, 3)
    geometry: Float32  # (m, h, w, 5)
    log_scale: Float32  # (m, h, w) logarithm of the first scale, which is a cue
    K: Float32  # (m, 4) fx fy cx cy
    T_camera_world: Float32  # (m, 3, 4)
    labels: NDArray[np.int16]  # (m, H, W) known labels, -1 = none; (m, 0, 0) where no view has any


class _Settings(NamedTuple):
    heads: int
    at_surface: bool  # one token a view for the attention across views and for blending
    colour_scale: float  # of the colours whose moments the density depends on; 0 = on none
    sample_weight_threshold: float = 0.0  # samples of a smaller fraction of their ray's weight are not attended to
    log_ratio: float = math.log(1 / TAU)  # of Eq. 12
    hidden_below: float = HIDDEN
    least_visibility: float = LEAST_VISIBILITY
    label_uncertainty: float = LABEL_UNCERTAINTY
    own_density_offset: float = OWN_DENSITY_OFFSET
    min_depth_m: float = MIN_DEPTH_M
    background_m: float = BACKGROUND_M
    own_radius_m: float = OWN_RADIUS_M


class _Layer(NamedTuple):
    weight: Float32  # (in, out); (2, in) of layers with two outputs
    bias: Float32  # (out,)


class _Attention(NamedTuple):
    qkv: Float32  # (C, 3 C); (0, 0) where the model has no such attention
    out: Float32  # (C, C)


class _Weights(NamedTuple):
    radial: _Attention
    cross: _Attention
    view_hidden: _Layer
    view_scores: _Layer  # (2, in)
    density_hidden: _Layer
    density_token: _Layer
    density_qkv: Float32
    density_out_hidden: _Layer
    density_out: _Layer  # (2, in)
    semantic_hidden: _Layer
    semantic_out: _Layer


class _Rendered(NamedTuple):
    feature: Float32  # (R, C)
    colour: Float32  # (R, 3)
    depth_m: Float32  # (R,)
    opacity: Float32  # (R,)
    known: NDArray[np.bool_]  # (R,)
    carried: Float32  # (R, L) labels that the views carry over


@parallel_kernel(chunks_per_thread=4)
def render_sray(
    count: int, rays: _Rays, maps: _SourceMaps, settings: _Settings, weights: _Weights, out: _Rendered
) -> None:
    """Render ``count`` rays into ``out``, before the classifier; see ``SRay.render_samples``."""


def _source_maps(sources: EncodedViews, channels: int) -> _SourceMaps:
    """The maps as the kernel takes them: without a copy where they are channels-last.
    Raises ShapeError: maps that do not fit together, or not the model."""
    sizes = expect_shape(sources.feature, f"M {channels} H W", "source features")
    m, h, w = sizes["M"], sizes["H"], sizes["W"]
    expect_shape(sources.rgb, f"{m} 3 {h} {w}", "source rgb")
    expect_shape(sources.geometry, f"{m} {GEOMETRY_CHANNELS} {h} {w}", "source geometry")
    expect_shape(sources.K, f"{m} 3 3", "source K")
    expect_shape(sources.T_camera_world, f"{m} 4 4", "source T_camera_world")
    expect_shape(sources.channel, f"{m} H W", "source channel")
    labels = sources.channel if (sources.channel >= 0).any() else sources.channel[:, :0, :0]
    K = sources.K
    return _SourceMaps(
        _array(sources.feature.permute(0, 2, 3, 1)),
        _array(sources.rgb.permute(0, 2, 3, 1)),
        _array(sources.geometry.permute(0, 2, 3, 1)),
        _array(sources.geometry[:, 1].log()),
        _array(torch.stack((K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]), dim=1)),
        _array(sources.T_camera_world[:, :3]),
        labels.to(torch.int16).contiguous().numpy(),
    )


def _pack_weights(model: SRay) -> _Weights:
    off = _Attention(np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32))
    config, density = model.config, model.density
    return _Weights(
        radial=_attention(model.radial) if config.intra_view_attention else off,
        cross=_attention(model.cross) if config.cross_view_attention else off,
        view_hidden=_layer(model.weights.net[0]),
        view_scores=_two_outputs(model.weights.net[2]),
        density_hidden=_layer(density.token[0]),
        density_token=_layer(density.token[2]),
        density_qkv=_transposed(density.qkv),
        density_out_hidden=_layer(density.out[0]),
        density_out=_two_outputs(density.out[2]),
        semantic_hidden=_layer(model.semantic[0]),
        semantic_out=_layer(model.semantic[2]),
    )


def _array(tensor: torch.Tensor) -> Float32:
    return tensor.detach().float().contiguous().numpy()


def _transposed(layer: nn.Module) -> Float32:
    assert isinstance(layer, nn.Linear)
    return np.ascontiguousarray(layer.weight.detach().float().cpu().numpy().T)


def _attention(layer: MultiHeadAttention) -> _Attention:
    return _Attention(_transposed(layer.qkv), _transposed(layer.out))


def _layer(layer: nn.Module) -> _Layer:
    assert isinstance(layer, nn.Linear)
    return _Layer(_transposed(layer), _array(layer.bias).copy())


def _two_outputs(layer: nn.Module) -> _Layer:
    assert isinstance(layer, nn.Linear)
    return _Layer(_array(layer.weight).copy(), _array(layer.bias).copy())
