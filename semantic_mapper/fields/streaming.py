"""S-Ray for streaming: the weights and the answer of ``SRay``, by OpenVINO and a compiled kernel on the CPU."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig, SRayConfig
from semantic_mapper.errors import ShapeError, WeightsError
from semantic_mapper.fields import numbers
from semantic_mapper.fields.base import CHUNK, MAX_SOURCE_VIEWS, EncodedSize, Rays, Rendered, WorkingView
from semantic_mapper.fields.inference import ImageNetwork, check_networks
from semantic_mapper.fields.sampling import guided_samples
from semantic_mapper.fields.surface_maps import has_depth, surface_maps
from semantic_mapper.fields.weights import Tensors
from semantic_mapper.geometry import camera_matrix, expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, Float64

PICTURE_WIDTH = 160  # of the pictures whose features are kept: those of other sizes differ
ALIGNMENT = 64  # bytes: a matrix product rounds differently where a matrix begins elsewhere


class StreamedViews(NamedTuple):
    """m encoded views of one size, as the kernel takes them."""

    feature: Float32  # (m, h, w, C) the F_j of S-Ray Eq. 5
    rgb: Float32  # (m, h, w, 3) in [0, 1]
    geometry: Float32  # (m, h, w, 5) mixture of logistics along each view ray; see ``sray``
    log_scale: Float32  # (m, h, w) logarithm of the first scale, which is a cue
    K: Float32  # (m, 4) fx fy cx cy in pixels of (h, w)
    T_camera_world: Float32  # (m, 3, 4)
    # (m, H, W) known labels at the size of the encoded images, -1 = none; (m, 0, 0) where no view has any
    channel: NDArray[np.int16]

    @property
    def size(self) -> EncodedSize:
        """Of the feature maps."""
        return self.feature.shape[1:], ()

    def at(self, T_world_camera: Float64) -> "StreamedViews":
        """One view with another pose (4, 4)."""
        return self._replace(T_camera_world=_inverse(T_world_camera))


class StreamingSRay:
    """Inference-only S-Ray on the CPU. Satisfies ``StreamField``.

    ``tensors`` are those of a weights file of this ``config``. ``sampling``: guided sampling round the depth prior.
    ``like``: one whose encoder has the same weights (``weights.encode_alike``), whose networks are shared.
    Raises WeightsError: tensors that do not fit the config."""

    holds_scene = False  # it knows no scene but by its views
    rays_per_chunk = CHUNK

    def __init__(
        self,
        config: SRayConfig,
        label_set: LabelSet,
        tensors: Tensors,
        sampling: SamplingConfig | None = None,
        *,
        like: "StreamingSRay | None" = None,
    ) -> None:
        self.config = config
        self.label_set = label_set
        self.sampling = sampling or SamplingConfig()
        self.picture: Float32 | None = None  # (D,) of the view that was encoded last; see ``domain_check``
        read = _Read(tensors)
        try:
            check_networks(read, config)
            self._weights = _pack_weights(read, config, len(label_set))
        except (KeyError, ShapeError) as error:
            reason = f"there is no {error}" if isinstance(error, KeyError) else str(error)
            raise WeightsError(f"weights do not fit their model config: {reason}") from error
        if others := [n for n in tensors if n not in read.names and not n.endswith(".num_batches_tracked")]:
            raise WeightsError(f"weights do not fit their model config: it has no '{others[0]}'")
        self._tensors = tensors
        self._classifier = _Layer(tensors["classifier.weight"].T, tensors["classifier.bias"])
        self._label_logit: Float32 = tensors["label_logit"]
        self._networks: dict[tuple[int, int, bool], ImageNetwork] = like._networks if like else {}
        at_surface = config.tokens == "surface"
        self._settings = _Settings(config.heads, at_surface, numbers.COLOUR_SCALE if at_surface else 0.0)
        self._own_factors = tensors["own_view_factor"] if at_surface else np.ones(2, np.float32)

    def encode(self, view: WorkingView) -> StreamedViews:
        """As ``SRay.encode``. Raises ShapeError: arrays that do not fit together."""
        height, width = expect_shape(view.rgb, "H W 3", "source rgb").values()
        for name in ("depth_m", "channel", "depth_sigma_m"):
            if (image := getattr(view, name)) is not None:
                expect_shape(image, f"{height} {width}", f"source {name}")
        depth, spread = view.depth_m, np.zeros_like(view.depth_m)
        if view.depth_sigma_m is not None:
            # What was computed and is not sure becomes a hole; all of it, for weights that have not learned from such.
            sure = view.depth_sigma_m <= (numbers.UNSURE_SPREAD if self.config.encoder.computed_depth else 0) * depth
            depth = depth * sure
            spread = (view.depth_sigma_m * sure / np.maximum(depth, np.float32(1e-3))).astype(np.float32, copy=False)
        K = camera_matrix(view.intrinsics).astype(np.float32)
        with_depth = self.config.encoder.depth and has_depth(depth)
        network = self._network(height, width, with_depth)
        h, w = network.size
        # Nearest, not averaged: a mean of depths across an edge lies on no surface.
        rows, columns = (((np.arange(n) + 0.5) * (full / n)).astype(int) for n, full in ((h, height), (w, width)))
        small = np.ix_(rows, columns)
        maps = surface_maps(depth, K) if with_depth else None
        focal = float(K[0, 0]) / width
        feature, geometry, rgb, picture = network.encode(view.rgb, maps, depth[small], spread[small], focal)
        scale = np.array((w / width, h / height), np.float32)
        lens = np.concatenate((K.diagonal()[:2] * scale, (K[:2, 2] + 0.5) * scale - 0.5))
        none = np.empty((0, 0), np.int16)
        channel = none if view.channel is None else view.channel.astype(np.int16)
        pose = _inverse(view.T_world_camera)
        self.picture = picture if width == PICTURE_WIDTH and picture.size else None
        lens, log_scale = lens[None].astype(np.float32), np.log(geometry[None, ..., 1])
        return StreamedViews(feature[None], rgb[None], geometry[None], log_scale, lens, pose, channel[None])

    def stack(self, views: Sequence[StreamedViews]) -> StreamedViews:
        """Join encoded views of one size. Raises ShapeError: none or too many views, or different sizes."""
        count = sum(len(v.feature) for v in views)
        if not 1 <= count <= MAX_SOURCE_VIEWS:
            raise ShapeError(f"a render takes 1 to {MAX_SOURCE_VIEWS} source views, got {count}")
        sizes = {v.size for v in views}
        if len(sizes) != 1:
            raise ShapeError(f"source views must share one resolution, got {sorted(sizes)}")
        rows, columns = max(v.channel.shape[1:] for v in views)
        channel = [labels for v in views for labels in _labels(v, rows, columns)]
        maps = map(np.concatenate, zip(*(v[:-1] for v in views), strict=True))
        return StreamedViews(*maps, channel=np.stack(channel))

    def source_logits(self, sources: StreamedViews) -> Float32:
        """Logits (h, w, L) of an encoded image by itself."""
        s, weights = sources.feature[0], self._weights
        hidden = np.maximum(s @ weights.semantic_hidden.weight + weights.semantic_hidden.bias, 0)
        s = s + hidden @ weights.semantic_out.weight + weights.semantic_out.bias
        return s @ self._classifier.weight + self._classifier.bias

    def release(self) -> None:
        """Give up the compiled networks."""
        self._networks.clear()

    def render(self, rays: Rays, sources: StreamedViews) -> Rendered:
        """Render rays with guided samples."""
        z = guided_samples(rays.prior_depth_m, rays.near_m, rays.far_m, self.sampling)
        return self.render_samples(rays, z, sources, self.sampling.sample_weight_threshold)

    def render_samples(
        self, rays: Rays, z: Float32, sources: StreamedViews, sample_weight_threshold: float = 0.0
    ) -> Rendered:
        """Render rays at given sample depths z (R, N); see ``SRay.render_samples``.
        Raises ShapeError: fewer than 2 samples a ray, or maps that do not fit together, or not the model."""
        if z.shape[1] < 2:
            raise ShapeError(f"a ray needs at least 2 samples for its intervals to have a length, got {z.shape[1]}")
        count = len(z)
        expect_shape(rays.origin, f"{count} 3", "ray origins")
        expect_shape(rays.direction, f"{count} 3", "ray directions")
        _check_views(sources, self.config.feature_dim)
        rendered = _aligned(count, self.config.feature_dim)
        colour, carried = np.empty((count, 3), np.float32), np.empty((count, len(self.label_set)), np.float32)
        depth, opacity = np.empty(count, np.float32), np.empty(count, np.float32)
        known = np.empty(count, np.bool_)
        own = np.where(rays.measured, *self._own_factors)
        render_sray(
            count,
            _Rays(rays.origin, rays.direction, z, own.astype(np.float32)),
            sources,
            self._settings._replace(sample_weight_threshold=sample_weight_threshold),
            self._weights,
            _Rendered(rendered, colour, depth, opacity, known, carried),
        )
        weight, bias = self._classifier
        offset = bias if self._settings.at_surface else opacity[:, None] * bias
        logits = np.asarray(rendered @ weight + offset + self._label_logit * carried, np.float32)
        logits *= known[:, None]
        return Rendered(logits, depth, opacity, colour, known)

    def _network(self, height: int, width: int, with_depth: bool) -> ImageNetwork:
        key = height, width, with_depth
        if key not in self._networks:
            self._networks[key] = ImageNetwork(self._tensors, self.config, (height, width), with_depth=with_depth)
        return self._networks[key]


class _Read(Mapping[str, NDArray[Any]]):
    """Tensors, and the ``names`` of those that were read."""

    def __init__(self, tensors: Tensors) -> None:
        self._tensors = tensors
        self.names: set[str] = set()

    def __getitem__(self, name: str) -> NDArray[Any]:
        self.names.add(name)
        return self._tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)


class _Rays(NamedTuple):
    origin: Float32  # (R, 3)
    direction: Float32  # (R, 3)
    z: Float32  # (R, N) ascending
    own_factor: Float32  # (R,) times which the own view's weight counts, of tokens at the surface


class _Settings(NamedTuple):
    heads: int
    at_surface: bool  # one token a view for the attention across views and for blending
    colour_scale: float  # of the colours whose moments the density depends on; 0 = on none
    sample_weight_threshold: float = 0.0  # samples of a smaller fraction of their ray's weight are not attended to
    log_ratio: float = math.log(1 / numbers.TAU)  # of Eq. 12
    hidden_below: float = numbers.HIDDEN
    least_visibility: float = numbers.LEAST_VISIBILITY
    label_uncertainty: float = numbers.LABEL_UNCERTAINTY
    own_density_offset: float = numbers.OWN_DENSITY_OFFSET
    min_depth_m: float = numbers.MIN_DEPTH_M
    background_m: float = numbers.BACKGROUND_M
    own_radius_m: float = numbers.OWN_RADIUS_M


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
    count: int, rays: _Rays, maps: StreamedViews, settings: _Settings, weights: _Weights, out: _Rendered
) -> None:
    """Render ``count`` rays into ``out``, before the classifier; see ``SRay.render_samples``."""


def _check_views(sources: StreamedViews, channels: int) -> None:
    sizes = expect_shape(sources.feature, f"M h w {channels}", "source features")
    count, size = sizes["M"], f"{sizes['M']} {sizes['h']} {sizes['w']}"
    expect_shape(sources.rgb, f"{size} 3", "source rgb")
    expect_shape(sources.geometry, f"{size} {numbers.GEOMETRY_CHANNELS}", "source geometry")
    expect_shape(sources.log_scale, size, "source log_scale")
    expect_shape(sources.K, f"{count} 4", "source K")
    expect_shape(sources.T_camera_world, f"{count} 3 4", "source T_camera_world")
    expect_shape(sources.channel, f"{count} H W", "source channel")


def _labels(views: StreamedViews, rows: int, columns: int) -> list[NDArray[np.int16]]:
    """Known labels of each view at one size: images of odd and of even sizes have features of one size."""
    if not views.channel.size:
        return [np.full((rows, columns), -1, np.int16)] * len(views.K)
    size = columns, rows
    return [np.asarray(cv2.resize(c, size, interpolation=cv2.INTER_NEAREST), np.int16) for c in views.channel]


def _inverse(T_world_camera: Float64) -> Float32:
    """(1, 3, 4), of the pose in float32, as rays have it: those of this very camera start at its centre."""
    T = T_world_camera.astype(np.float32)
    R_camera_world = T[:3, :3].T
    return np.ascontiguousarray(np.concatenate((R_camera_world, -R_camera_world @ T[:3, 3:]), axis=1)[None])


def _aligned(rows: int, columns: int) -> Float32:
    """An empty matrix that begins at a multiple of ``ALIGNMENT``."""
    memory = np.empty(4 * rows * columns + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + 4 * rows * columns].view(np.float32).reshape(rows, columns)


def _pack_weights(tensors: Tensors, config: SRayConfig, classes: int) -> _Weights:
    """Raises KeyError: a tensor is missing; its name. ShapeError: one is of another shape."""
    dim, values = config.feature_dim, config.feature_dim + (3 if config.tokens == "surface" else 0)
    cues = numbers.SURFACE_CUES if config.tokens == "surface" else numbers.CUES

    def matrix(name: str, out: int, size: int) -> Float32:
        expect_shape(tensors[name], f"{out} {size}", f"'{name}'")
        return np.ascontiguousarray(tensors[name], np.float32)

    def transposed(name: str, out: int, size: int) -> Float32:
        return np.ascontiguousarray(matrix(name, out, size).T)

    def layer(name: str, out: int, size: int) -> _Layer:
        expect_shape(tensors[f"{name}.bias"], f"{out}", f"'{name}.bias'")
        weight = f"{name}.weight"
        two = out == 2  # outputs, which C takes by rows
        return _Layer((matrix if two else transposed)(weight, out, size), tensors[f"{name}.bias"].astype(np.float32))

    def attention(name: str, there: bool) -> _Attention:
        found = transposed(f"{name}.qkv.weight", 3 * dim, dim), transposed(f"{name}.out.weight", dim, dim)
        return _Attention(*(matrix if there else matrix[:0, :0] for matrix in found))

    matrix("classifier.weight", classes, dim)
    expect_shape(tensors["classifier.bias"], f"{classes}", "'classifier.bias'")
    expect_shape(tensors["label_logit"], "", "'label_logit'")
    if config.tokens == "surface":
        expect_shape(tensors["own_view_factor"], "2", "'own_view_factor'")
    return _Weights(
        radial=attention("radial", config.intra_view_attention),
        cross=attention("cross", config.cross_view_attention),
        view_hidden=layer("weights.net.0", 16, dim + cues),
        view_scores=layer("weights.net.2", 2, 16),
        density_hidden=layer("density.token.0", 32, 2 * values + 4),
        density_token=layer("density.token.2", 16, 32),
        density_qkv=transposed("density.qkv.weight", 48, 16),
        density_out_hidden=layer("density.out.0", 16, 16),
        density_out=layer("density.out.2", 2, 16),
        semantic_hidden=layer("semantic.0", 2 * dim, dim),
        semantic_out=layer("semantic.2", dim, 2 * dim),
    )
