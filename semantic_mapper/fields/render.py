"""Render whole views from a semantic field, chunk by chunk: every pixel, or with fewer rays.

With fewer rays it renders a coarse grid, then, level by level, those between it where it does not tell enough. Between
rays that say the same of the same surface there is nothing to find; at borders of classes, of depth and of colour, and
where the field is uncertain, there is.
"""

from __future__ import annotations

# torch and safetensors leave parts of their interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import EncodedViews, SemanticField
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.rays import pixel_rays
from semantic_mapper.types import CameraIntrinsics, FieldRender, Float32, Float64, UInt8

CPU_CHUNK = 2048  # rays rendered at once: what fits in a core's cache
GPU_CHUNK = 32768  # enough to fill one, as long as
GPU_PAIRS = GPU_CHUNK * 16**2  # pairs of samples that attend to each other are no more: 1 GB of scores for 8 views
COARSEST = 4  # pixels between the first rays, a power of two


def chunk_size(rays_per_chunk: int, device: torch.device, sampling: SamplingConfig) -> int:
    """Rays to render at once; 0 = what suits the device."""
    if rays_per_chunk or device.type == "cpu":
        return rays_per_chunk or CPU_CHUNK
    samples = sampling.guided if sampling.mode == "streaming" else sampling.coarse + sampling.fine
    return max(1, min(GPU_CHUNK, GPU_PAIRS // samples**2))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A view (H, W) to render from a field, without gradients."""

    field: SemanticField
    sources: EncodedViews
    intrinsics: CameraIntrinsics
    T_world_camera: Float64
    prior_depth_m: Float32  # (H, W), 0 = no prior
    sampling: SamplingConfig  # for its near and far bounds
    rays_per_chunk: int = 0  # rendered at once; 0 = what suits the device
    measured: NDArray[np.bool_] | None = None  # (H, W), where the prior is not filled in; None = wherever there is one
    stamp_ns: int | None = None  # for fields with things that move; None = such things are not there

    def trace(self, flat: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], FieldRender]]:
        """Pixels ``flat`` (R,), row by row, and what they render to, chunk by chunk."""
        device, sampling, measured = self.sources.feature.device, self.sampling, self.measured
        pose = torch.tensor(self.T_world_camera, device=device, dtype=torch.float32)
        size = chunk_size(self.rays_per_chunk, device, sampling)
        for start in range(0, len(flat), size):
            part = flat[start : start + size]
            v, u = np.divmod(part, self.intrinsics.width)
            rays = pixel_rays(
                torch.from_numpy(np.stack((u, v), axis=1).astype(np.float32)).to(device),
                self.intrinsics,
                pose,
                near_m=sampling.near_m,
                far_m=sampling.far_m,
                prior_depth_m=torch.from_numpy(self.prior_depth_m[v, u]).to(device),
                measured=None if measured is None else torch.from_numpy(measured[v, u]).to(device),
                stamp_ns=self.stamp_ns,
            )
            with torch.inference_mode():
                yield part, self.field.render(rays, self.sources)


def render_image(view: View) -> FieldRender:
    """Every pixel of a view: a ``FieldRender`` of H * W rays, row by row."""
    parts = [render for _, render in view.trace(np.arange(view.prior_depth_m.size))]
    return FieldRender(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(FieldRender)))


def render_view(view: View) -> tuple[Float32, NDArray[np.bool_], Float32]:
    """``render_image`` as arrays: class probabilities (H, W, L), known (H, W), depth (H, W) in metres."""
    parts = [_arrays(render) for _, render in view.trace(np.arange(view.prior_depth_m.size))]
    probabilities, known, depth_m = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    shape = (view.intrinsics.height, view.intrinsics.width)
    return probabilities.reshape(*shape, -1), known.reshape(shape), depth_m.reshape(shape)


def _arrays(render: FieldRender) -> tuple[Float32, NDArray[np.bool_], Float32]:
    """Class probabilities (R, L), known (R,), and depth (R,), 0 where not known."""
    with torch.inference_mode():
        probabilities = torch.softmax(render.logits, dim=-1).cpu().numpy()
        return probabilities, render.known.cpu().numpy(), (render.depth_m * render.known).cpu().numpy()


def render_sparse_view(view: View, rgb: UInt8, fraction: float) -> tuple[Float32, NDArray[np.bool_], Float32, int]:
    """As ``render_view``, with rays for at most a ``fraction`` (0..1) of the pixels, the most uncertain first, and for
    every fourth a side at least; and the number of rays.

    Edges of ``rgb`` (H, W, 3) tell where to look closer. Pixels without a ray hold the mean of the known ones round
    them. Raises ShapeError: images of another size than the view."""
    height, width = view.intrinsics.height, view.intrinsics.width
    expect_shape(rgb, f"{height} {width} 3", "view rgb")
    expect_shape(view.prior_depth_m, f"{height} {width}", "depth prior")
    rgb, prior_depth_m = np.ascontiguousarray(rgb), np.ascontiguousarray(view.prior_depth_m)
    probabilities = np.zeros((height, width, len(view.field.label_set)), np.float32)
    known, depth_m = np.zeros((height, width), np.bool_), np.zeros((height, width), np.float32)

    def trace(flat: NDArray[np.int64]) -> None:
        for part, render in view.trace(flat):
            v, u = np.divmod(part, width)
            probabilities[v, u], known[v, u], depth_m[v, u] = _arrays(render)

    coarse = np.arange(height * width).reshape(height, width)[::COARSEST, ::COARSEST].ravel()
    trace(coarse)
    traced, step = len(coarse), COARSEST
    while step > 1:
        uncertainty = np.zeros((height, width), np.float32)
        half = step // 2
        rows = (height + half - 1) // half
        fill_between_rays(rows, step, probabilities, known, depth_m, prior_depth_m, rgb, uncertainty)
        flat = np.flatnonzero(uncertainty)
        left = max(int(fraction * height * width) - traced, 0)
        if len(flat) > left:
            flat = flat[np.argsort(-uncertainty.ravel()[flat], kind="stable")[:left]]
        trace(np.sort(flat))
        traced, step = traced + len(flat), step // 2
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
