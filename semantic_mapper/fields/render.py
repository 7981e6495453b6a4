"""Render whole views from a semantic field, chunk by chunk."""

from __future__ import annotations

# torch and safetensors leave parts of their interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import EncodedViews, SemanticField
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.types import CameraIntrinsics, FieldRender, Float32, Float64

CPU_CHUNK = 2048  # rays rendered at once: what fits in a core's cache
GPU_CHUNK = 32768  # enough to fill one, as long as
GPU_PAIRS = GPU_CHUNK * 16**2  # pairs of samples that attend to each other are no more: 1 GB of scores for 8 views


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
