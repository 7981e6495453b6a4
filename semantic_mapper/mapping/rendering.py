"""The semantics of one view, with as many rays and samples as the settings, or the rate to hold, allow.

``add_own_image`` joins it with what the frame's image says by itself at coarse pixels; rays are few. ``upsample``
brings the coarse view to the size of the frame, along the edges of its image and depth: an index a pixel, not a vector
of probabilities a pixel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from semantic_mapper.config import RenderConfig, SamplingConfig
from semantic_mapper.fields.base import StreamField
from semantic_mapper.fields.render import View, render_sparse_view, render_view
from semantic_mapper.fields.sampling import around_computed
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.fusion import PROBABILITY_FLOOR
from semantic_mapper.types import Bool, Float32, Int32, Int64, UInt8

SAMPLES_WITHOUT_DEPTH = 32  # a ray, of views of which neither sensor nor map knows any depth
LEAST_SAMPLES = 2
LEAST_SHARE = 0.1  # of the pixels; below, samples go first
RESERVE = 0.9  # of a frame's time is planned for: frames differ
MEMORY = 0.7  # of what was known stays when a new frame is measured


class RenderedView(NamedTuple):
    """What a field says of a view. ``rays`` were rendered, with so many ``samples`` each; 0 where the field draws its
    own. Pixels that are not ``traced`` have none and hold the mean of those round them; None: all have one."""

    probabilities: Float32  # (h, w, L)
    known: Bool  # (h, w) where they mean something
    depth_m: Float32  # (h, w), or 0
    rays: int = 0
    samples: int = 0
    traced: Bool | None = None  # (h, w)


class ViewRenderer:
    """Renders views from one field."""

    def __init__(self, field: StreamField[Any], config: RenderConfig, sampling: SamplingConfig) -> None:
        self.field = field  # may be exchanged for one of the same kind
        self._config = config
        self._sampling = sampling
        self._rate_controller: RateController | None = None
        if config.target_hz > 0:
            self._rate_controller = RateController(config.target_hz, config.ray_fraction, sampling)
        self._last = (0, 0)  # rays and samples of the last view, where its time tells of the next one's

    def note(self, render_ms: float, other_ms: float) -> None:
        """What the frame of the last view took: its rendering, and all else."""
        if self._rate_controller is not None:
            self._rate_controller.note(render_ms, other_ms, *self._last)

    def render(self, view: View, rgb: UInt8, *, computed: bool = False, share: float = 1.0) -> RenderedView:
        """Render a view (h, w) of the field, with samples as the settings, or the rate to hold, say.

        ``rgb`` is (h, w, 3) uint8; ``computed``: the depth prior was computed from pictures and may be farther off;
        ``share`` of the rays is enough, where not all pixels have one."""
        prior_m = view.prior_depth_m
        fraction, sampling = self._config.ray_fraction, self._sampling
        if self._rate_controller is not None:
            fraction, sampling = self._rate_controller.choose(prior_m.size)
        blind = not prior_m.any()
        if blind:
            sampling = msgspec.structs.replace(sampling, guided=max(SAMPLES_WITHOUT_DEPTH, sampling.guided))
        elif computed:
            sampling = around_computed(sampling)
        samples = 0
        if sampling.mode == "streaming":
            self.field.sampling = sampling
            samples = sampling.guided
        view = replace(view, sampling=sampling)
        if fraction == 1:
            probabilities, known, depth_m = render_view(view)
            rays, traced = prior_m.size, None
        else:
            probabilities, known, depth_m, traced = render_sparse_view(view, rgb, share * fraction)
            rays = int(np.count_nonzero(traced))
        self._last = (0 if blind else rays, samples)
        return RenderedView(probabilities, known, depth_m, rays, samples, traced)


def add_own_image(view: RenderedView, own: Float32, weight: float, where: Bool | None = None) -> RenderedView:
    """The geometric mean of a view (h, w) and what the frame's own image says by itself, logits of any size, which
    weighs 0..1; where the view is known, and only ``where`` (h, w) is true."""
    size = view.known.shape
    if own.shape[:2] != size:
        own = np.asarray(cv2.resize(own, size[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    own = np.ascontiguousarray(own, np.float32)
    joined = view.probabilities.copy()
    rows = (own.reshape(-1, own.shape[2]), joined.reshape(-1, own.shape[2]))
    known = view.known if where is None else view.known & where
    join_opinions(len(rows[0]), *rows, np.ascontiguousarray(known).ravel(), weight, PROBABILITY_FLOOR)
    return view._replace(probabilities=joined)


@parallel_kernel()
def join_opinions(count: int, own: Float32, probabilities: Float32, known: Bool, weight: float, floor: float) -> None:
    """Replace ``probabilities`` (N, L) that are ``known`` (N,) by the mean of ``add_own_image`` with ``own`` logits."""


class RateController:
    """Trades rays, then samples, for a target rate: at most this ``fraction`` of the pixels, and these samples. A
    frame's time is modelled as a part that does not depend on rays, and a cost a ray and sample; so a map is not
    reproducible."""

    def __init__(self, target_hz: float, fraction: float, sampling: SamplingConfig) -> None:
        self._budget_ms = RESERVE * 1e3 / target_hz
        self._fraction = fraction
        self._sampling = sampling
        self._other_ms: float | None = None
        self._sample_ms: float | None = None  # of one sample of one ray

    def choose(self, pixels: int) -> tuple[float, SamplingConfig]:
        """Fraction of the ``pixels`` of the rendered view that may have rays, and the samples a ray."""
        if self._other_ms is None or self._sample_ms is None:
            return self._fraction, self._sampling
        samples = max(self._budget_ms - self._other_ms, 0.0) / self._sample_ms
        count = self._sampling.guided
        while count > LEAST_SAMPLES and samples / (count * pixels) < min(LEAST_SHARE, self._fraction):
            count -= 1
        free = min(self._sampling.free_space, count - LEAST_SAMPLES)
        sampling = msgspec.structs.replace(self._sampling, guided=count, free_space=free)
        return min(samples / (count * pixels), self._fraction), sampling

    def note(self, render_ms: float, other_ms: float, rays: int, samples: int) -> None:
        """What a frame took: its rendering, and all else."""
        self._other_ms = _follow(self._other_ms, other_ms)
        if rays:
            self._sample_ms = _follow(self._sample_ms, render_ms / (rays * samples))


def _follow(old: float | None, new: float) -> float:
    return new if old is None else MEMORY * old + (1 - MEMORY) * new


def upsample(
    probabilities: Float32, known: Bool, rgb_low: UInt8, depth_low: Float32, rgb: UInt8, depth: Float32
) -> Int32:
    """Joint bilateral upsampling: every full pixel takes one of the 3x3 coarse pixels round it.

    It is of the class that these nine give together, weighted by how much they look like the pixel, and of that class
    the one that is most like it. Where all nine are of one class it takes the middle one.

    Args:
        probabilities, known: (h, w, L) float32 and (h, w) bool.
        rgb_low, depth_low: (h, w, 3) uint8 and (h, w) float32 at the coarse pixels.
        rgb, depth: (H, W, 3) uint8 and (H, W) float32; depth 0 = none, then colour alone decides.

    Returns:
        (H, W) int32 number of the coarse pixel (row * w + column), -1 where none of the nine is known.
    """
    sizes = expect_shape(probabilities, "h w L", "coarse probabilities")
    coarse = f"{sizes['h']} {sizes['w']}"
    expect_shape(known, coarse, "coarse known")
    expect_shape(rgb_low, f"{coarse} 3", "coarse rgb")
    expect_shape(depth_low, coarse, "coarse depth")
    sizes = expect_shape(depth, "H W", "depth")
    expect_shape(rgb, f"{sizes['H']} {sizes['W']} 3", "rgb")
    out = np.full(depth.shape, -1, np.int32)
    if not known.size:
        return out
    channel = np.where(known, likeliest(probabilities)[0], -1)
    look = np.dstack((rgb_low.astype(np.float32), depth_low))
    one_class = np.empty(channel.shape, np.bool_)
    find_one_class(len(channel), channel, one_class)
    table = np.ascontiguousarray(probabilities.reshape(-1, probabilities.shape[2]))
    images = np.ascontiguousarray(rgb), np.ascontiguousarray(depth)
    upsample_view(len(depth), table, channel, one_class, look, *images, out)
    return out


def likeliest(probabilities: Float32) -> tuple[Int64, Float32]:
    """Number of the likeliest class of each pixel (h, w), of (h, w, L), and its probability."""
    height, width, classes = probabilities.shape
    channel, most = np.empty((height, width), np.int64), np.empty((height, width), np.float32)
    likeliest_rows(
        height * width, np.ascontiguousarray(probabilities).reshape(-1, classes), channel.ravel(), most.ravel()
    )
    return channel, most


@parallel_kernel()
def likeliest_rows(count: int, probabilities: Float32, channel: Int64, most: Float32) -> None:
    """``likeliest`` of ``count`` rows (N, L) into (N,) each."""


@parallel_kernel()
def find_one_class(count: int, channel: Int64, one_class: Bool) -> None:
    """Whether the 3x3 coarse pixels round each (h, w) are known and of one class; ``count`` is h."""


@parallel_kernel()
def upsample_view(
    count: int,
    probabilities: Float32,
    channel: Int64,
    one_class: Bool,
    look: Float32,
    rgb: UInt8,
    depth: Float32,
    out: Int32,
) -> None:
    """``upsample`` of ``count`` rows; ``look`` (h, w, 4) is colour and depth of the coarse pixels."""
