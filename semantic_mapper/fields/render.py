"""Render whole views from a semantic field, chunk by chunk: every pixel, or with fewer rays.

With fewer rays it renders a coarse grid, then, level by level, those between it where it does not tell enough. Between
rays that say the same of the same surface there is nothing to find; at borders of classes, of depth and of colour, and
where the field is uncertain, there is.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import Rays, Rendered, StreamField
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

COARSEST = 4  # pixels between the first rays, a power of two


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A view (H, W) to render from a field."""

    field: StreamField[Any]
    sources: Any  # what the field has encoded, one view or stacked
    intrinsics: CameraIntrinsics
    T_world_camera: Float64
    prior_depth_m: Float32  # (H, W), 0 = no prior
    sampling: SamplingConfig  # for its near and far bounds
    rays_per_chunk: int = 0  # rendered at once; 0 = what suits the field
    measured: NDArray[np.bool_] | None = None  # (H, W), where the prior is not filled in; None = wherever there is one
    stamp_ns: int | None = None  # for fields with things that move; None = such things are not there

    def trace(self, flat: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], Rendered]]:
        """Pixels ``flat`` (R,), row by row, and what they render to, chunk by chunk."""
        T, k, prior = self.T_world_camera.astype(np.float32), self.intrinsics, self.prior_depth_m
        size = self.rays_per_chunk or self.field.rays_per_chunk
        for start in range(0, len(flat), size):
            part = flat[start : start + size]
            v, u = np.divmod(part, k.width)
            # S-Ray Eq. 3 with z as the parameter: a direction has depth 1.
            direction = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(len(part))), axis=1)
            rays = Rays(
                origin=np.tile(T[:3, 3], (len(part), 1)),
                direction=direction.astype(np.float32) @ T[:3, :3].T,
                near_m=self.sampling.near_m,
                far_m=self.sampling.far_m,
                prior_depth_m=prior[v, u],
                measured=prior[v, u] > 0 if self.measured is None else self.measured[v, u],
                stamp_ns=self.stamp_ns,
            )
            yield part, self.field.render(rays, self.sources)


def render_image(view: View) -> Rendered:
    """Every pixel of a view: H * W rays, row by row."""
    parts = [render for _, render in view.trace(np.arange(view.prior_depth_m.size))]
    return Rendered(*map(np.concatenate, zip(*parts, strict=True)))


def render_view(view: View) -> tuple[Float32, NDArray[np.bool_], Float32]:
    """``render_image`` as images: class probabilities (H, W, L), known (H, W), depth (H, W) in metres."""
    probabilities, known, depth_m = _arrays(render_image(view))
    shape = (view.intrinsics.height, view.intrinsics.width)
    return probabilities.reshape(*shape, -1), known.reshape(shape), depth_m.reshape(shape)


def _arrays(render: Rendered) -> tuple[Float32, NDArray[np.bool_], Float32]:
    """Class probabilities (R, L), known (R,), and depth (R,), 0 where not known."""
    return softmax(render.logits), render.known, render.depth_m * render.known


def softmax(logits: Float32) -> Float32:
    """Probabilities along the last axis."""
    out = np.empty(logits.shape, np.float32)
    classes = logits.shape[-1]
    softmax_rows(out.size // classes, np.ascontiguousarray(logits).reshape(-1, classes), out.reshape(-1, classes))
    return out


@parallel_kernel()
def softmax_rows(count: int, logits: Float32, out: Float32) -> None:
    """``softmax`` of ``count`` rows (N, L), at most 256 classes."""


def render_sparse_view(
    view: View, rgb: UInt8, fraction: float
) -> tuple[Float32, NDArray[np.bool_], Float32, NDArray[np.bool_]]:
    """As ``render_view``, with rays for at most a ``fraction`` (0..1) of the pixels, the most uncertain first, and for
    every fourth a side at least; and which pixels (h, w) have one.

    Edges of ``rgb`` (H, W, 3) tell where to look closer. Pixels without a ray hold the mean of the known ones round
    them. Raises ShapeError: images of another size than the view."""
    height, width = view.intrinsics.height, view.intrinsics.width
    expect_shape(rgb, f"{height} {width} 3", "view rgb")
    expect_shape(view.prior_depth_m, f"{height} {width}", "depth prior")
    rgb, prior_depth_m = np.ascontiguousarray(rgb), np.ascontiguousarray(view.prior_depth_m)
    probabilities = np.zeros((height, width, len(view.field.label_set)), np.float32)
    known, traced = np.zeros((2, height, width), np.bool_)
    depth_m = np.zeros((height, width), np.float32)

    def trace(flat: NDArray[np.int64]) -> None:
        for part, render in view.trace(flat):
            v, u = np.divmod(part, width)
            probabilities[v, u], known[v, u], depth_m[v, u] = _arrays(render)
            traced[v, u] = True

    coarse = np.arange(height * width).reshape(height, width)[::COARSEST, ::COARSEST].ravel()
    trace(coarse)
    rays, step = len(coarse), COARSEST
    while step > 1:
        uncertainty = np.zeros((height, width), np.float32)
        half = step // 2
        rows = (height + half - 1) // half
        fill_between_rays(rows, step, probabilities, known, depth_m, prior_depth_m, rgb, uncertainty)
        flat = np.flatnonzero(uncertainty)
        left = max(int(fraction * height * width) - rays, 0)
        if len(flat) > left:
            flat = flat[np.argsort(-uncertainty.ravel()[flat], kind="stable")[:left]]
        trace(np.sort(flat))
        rays, step = rays + len(flat), step // 2
    return probabilities, known, depth_m, traced


@parallel_kernel()
def fill_between_rays(
    count: int,
    step: int,
    probabilities: Float32,
    known: NDArray[np.bool_],
    depth: Float32,
    prior: Float32,
    rgb: UInt8,
    uncertainty: Float32,
) -> None:
    """Give pixels half way between those of a grid (``step`` apart) the mean of the known grid pixels round them, in
    ``count`` rows half a step apart; ``uncertainty`` (H, W) gets how little the grid says of such a pixel."""
