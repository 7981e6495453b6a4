"""Render whole views from a semantic field, chunk by chunk: every pixel, or with fewer rays.

With fewer rays it renders a coarse grid, then, level by level, those between it where it does not tell enough. Between
rays that say the same of the same surface there is nothing to find; at borders of classes, of depth and of colour, and
where the field is uncertain, there is.
"""

from __future__ import annotations

# torch and safetensors leave parts of their interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import EncodedViews, SemanticField
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.types import CameraIntrinsics, FieldRender, Float32, Float64, UInt8

CPU_CHUNK = 2048  # rays rendered at once: what fits in a core's cache
GPU_CHUNK = 32768  # enough to fill one, as long as
GPU_PAIRS = GPU_CHUNK * 16**2  # pairs of samples that attend to each other are no more: 1 GB of scores for 8 views
COARSEST = 4  # pixels between the first rays, a power of two
DEPTH_STEP = 0.03  # fraction of z by which the depth prior leaves the plane through its neighbours across a border
COLOUR_STEP = 40.0  # 8-bit steps, summed over the channels, by which a colour differs from its neighbours' at an edge
UNSURE = 0.2  # probability that is not the likeliest class's, above which agreeing rays do not tell enough


def chunk_size(rays_per_chunk: int, device: torch.device, sampling: SamplingConfig) -> int:
    """Rays to render at once; 0 = what suits the device."""
    if rays_per_chunk or device.type == "cpu":
        return rays_per_chunk or CPU_CHUNK
    samples = sampling.guided if sampling.mode == "streaming" else sampling.coarse + sampling.fine
    return max(1, min(GPU_CHUNK, GPU_PAIRS // samples**2))


def render_image(
    field: SemanticField,
    sources: EncodedViews,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    prior_depth_m: Float32,
    sampling: SamplingConfig,
    rays_per_chunk: int,
    on_chunk: Callable[[int], None] | None = None,
    measured: NDArray[np.bool_] | None = None,
    stamp_ns: int | None = None,
) -> FieldRender:
    """Render every pixel of a view without gradients, row by row.

    Args:
        intrinsics: Of the view to render, (H, W).
        T_world_camera: (4, 4).
        prior_depth_m: (H, W), 0 = no prior.
        sampling: Near and far bounds.
        rays_per_chunk: Rays rendered at once; 0 = what suits the device.
        measured: (H, W), where the prior is not filled in; None = wherever there is one.
        on_chunk: Called with the number of rays done after each chunk.
        stamp_ns: Of the view, for fields with things that move; None = such things are not there.

    Returns:
        ``FieldRender`` of H * W rays.
    """
    device = sources.feature.device
    pixels = pixel_grid(intrinsics.width, intrinsics.height, device)
    prior = torch.from_numpy(np.ascontiguousarray(prior_depth_m)).to(device).flatten()
    seen = None if measured is None else torch.from_numpy(np.ascontiguousarray(measured)).to(device).flatten()
    pose = torch.tensor(T_world_camera, device=device, dtype=torch.float32)
    parts: list[FieldRender] = []
    rays_per_chunk = chunk_size(rays_per_chunk, device, sampling)
    with torch.inference_mode():
        for start in range(0, len(pixels), rays_per_chunk):
            rays = pixel_rays(
                pixels[start : start + rays_per_chunk],
                intrinsics,
                pose,
                near_m=sampling.near_m,
                far_m=sampling.far_m,
                prior_depth_m=prior[start : start + rays_per_chunk],
                measured=None if seen is None else seen[start : start + rays_per_chunk],
                stamp_ns=stamp_ns,
            )
            parts.append(field.render(rays, sources))
            if on_chunk is not None:
                on_chunk(min(start + rays_per_chunk, len(pixels)))
    return FieldRender(
        logits=torch.cat([p.logits for p in parts]),
        depth_m=torch.cat([p.depth_m for p in parts]),
        opacity=torch.cat([p.opacity for p in parts]),
        rgb=torch.cat([p.rgb for p in parts]),
        entropy=torch.cat([p.entropy for p in parts]),
        known=torch.cat([p.known for p in parts]),
    )


def render_view(
    field: SemanticField,
    sources: EncodedViews,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    prior_depth_m: Float32,
    sampling: SamplingConfig,
    rays_per_chunk: int,
    measured: NDArray[np.bool_] | None = None,
    stamp_ns: int | None = None,
) -> tuple[Float32, NDArray[np.bool_], Float32]:
    """``render_image`` as arrays: class probabilities (H, W, L), known (H, W), depth (H, W) in metres."""
    scene = (field, sources, intrinsics, T_world_camera, prior_depth_m, sampling, rays_per_chunk)
    render = render_image(*scene, measured=measured, stamp_ns=stamp_ns)
    shape = (intrinsics.height, intrinsics.width)
    probabilities = torch.softmax(render.logits, dim=-1).view(*shape, -1)
    return (
        probabilities.cpu().numpy(),
        render.known.view(shape).cpu().numpy(),
        (render.depth_m * render.known).view(shape).cpu().numpy(),
    )


def render_sparse_view(
    field: SemanticField,
    sources: EncodedViews,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    prior_depth_m: Float32,
    sampling: SamplingConfig,
    rays_per_chunk: int,
    rgb: UInt8,
    fraction: float,
    measured: NDArray[np.bool_] | None = None,
    stamp_ns: int | None = None,
) -> tuple[Float32, NDArray[np.bool_], Float32, int]:
    """As ``render_view``, with rays for at most a ``fraction`` of the pixels, and for every fourth a side at least.

    Args:
        rgb: (H, W, 3) uint8 colours of the view, whose edges tell where to look closer.
        fraction: Of the pixels that may have rays of their own, the most uncertain first; 0..1.
        measured: (H, W), where the prior is not filled in; None = wherever there is one.
        stamp_ns: Of the view, for fields with things that move; None = such things are not there.

    Returns:
        Class probabilities (H, W, L), known (H, W), depth (H, W) in metres, and the number of rays rendered. Pixels
        without a ray hold the mean of the known ones round them.

    Raises:
        ShapeError: images of another size than the view.
    """
    height, width = intrinsics.height, intrinsics.width
    expect_shape(rgb, f"{height} {width} 3", "view rgb")
    expect_shape(prior_depth_m, f"{height} {width}", "depth prior")
    rgb, prior_depth_m = np.ascontiguousarray(rgb), np.ascontiguousarray(prior_depth_m)
    probabilities = np.zeros((height, width, len(field.label_set)), np.float32)
    known, depth_m = np.zeros((height, width), np.bool_), np.zeros((height, width), np.float32)
    pose = torch.tensor(T_world_camera, device=sources.feature.device, dtype=torch.float32)
    rays_per_chunk = chunk_size(rays_per_chunk, pose.device, sampling)

    def trace(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> None:
        for start in range(0, len(rows), rays_per_chunk):
            v, u = rows[start : start + rays_per_chunk], columns[start : start + rays_per_chunk]
            pixels = torch.from_numpy(np.stack((u, v), axis=1).astype(np.float32)).to(pose.device)
            prior = torch.from_numpy(prior_depth_m[v, u]).to(pose.device)
            seen = None if measured is None else torch.from_numpy(measured[v, u]).to(pose.device)
            rays = pixel_rays(
                pixels,
                intrinsics,
                pose,
                near_m=sampling.near_m,
                far_m=sampling.far_m,
                prior_depth_m=prior,
                measured=seen,
                stamp_ns=stamp_ns,
            )
            with torch.inference_mode():
                render = field.render(rays, sources)
                probabilities[v, u] = torch.softmax(render.logits, dim=-1).cpu().numpy()
                known[v, u] = render.known.cpu().numpy()
                depth_m[v, u] = (render.depth_m * render.known).cpu().numpy()

    v, u = (grid.ravel() for grid in np.mgrid[0:height:COARSEST, 0:width:COARSEST])
    trace(v, u)
    traced, step = len(v), COARSEST
    while step > 1:
        uncertainty = np.zeros((height, width), np.float32)
        half = step // 2
        images = (probabilities, known, depth_m, prior_depth_m, rgb, uncertainty)
        fill_between_rays((height + half - 1) // half, step, *images, DEPTH_STEP, COLOUR_STEP, UNSURE)
        flat = np.flatnonzero(uncertainty)
        left = max(int(fraction * height * width) - traced, 0)
        if len(flat) > left:
            flat = flat[np.argsort(-uncertainty.ravel()[flat], kind="stable")[:left]]
        if len(flat):
            trace(*np.unravel_index(np.sort(flat), uncertainty.shape))
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
    depth_step: float,
    colour_step: float,
    unsure: float,
) -> None:
    """Give the pixels half way between those of a grid the mean of the known grid pixels round them; in place.

    Args:
        count: Rows of pixels, half a step apart.
        step: Pixels between those of the grid.
        probabilities: (H, W, L) float32, zeros but at the grid; written between it, as are ``known`` (H, W) bool and
            ``depth`` (H, W) float32 in metres.
        prior: (H, W) float32 depth prior in metres.
        rgb: (H, W, 3) uint8.
        uncertainty: (H, W) float32, written: how little the grid says of such a pixel, 0 = enough.
    """
    ...
