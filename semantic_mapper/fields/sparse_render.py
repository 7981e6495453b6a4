"""Render a view with fewer rays: a coarse grid, then, level by level, those between it where it does not tell enough.

Between rays that say the same of the same surface there is nothing to find; at borders of classes, of depth and of
colour, and where the field is in doubt, there is.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped, and so is what is compiled.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUntypedFunctionDecorator=false
import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import EncodedViews, SemanticField
from semantic_mapper.fields.render import chunk_size
from semantic_mapper.geometry import pixel_rays
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

COARSEST = 4  # pixels between the first rays, a power of two
DEPTH_STEP = 0.03  # share of z by which the depth prior leaves the plane through its neighbours across a border
COLOUR_STEP = 40.0  # 8-bit steps, summed over the channels, by which a colour differs from its neighbours' at an edge
UNSURE = 0.2  # probability that is not the likeliest class's, above which agreeing rays do not tell enough


def render_sparse_view(
    field: SemanticField,
    sources: EncodedViews,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    prior_depth_m: Float32,
    sampling: SamplingConfig,
    rays_per_chunk: int,
    rgb: UInt8,
    share: float,
) -> tuple[Float32, NDArray[np.bool_], Float32, int]:
    """As ``render_view``, with rays for at most a ``share`` of the pixels, and for every fourth a side at least.

    Args:
        rgb: (H, W, 3) uint8 colours of the view, whose edges tell where to look closer.
        share: Of the pixels that may have rays of their own, the most doubtful first; 0..1.

    Returns:
        Class probabilities (H, W, L), known (H, W), depth (H, W) in metres, and the number of rays rendered. Pixels
        without a ray hold the mean of the known ones round them.
    """
    height, width = intrinsics.height, intrinsics.width
    probabilities = np.zeros((height, width, len(field.label_set)), np.float32)
    known, depth_m = np.zeros((height, width), np.bool_), np.zeros((height, width), np.float32)
    pose = torch.tensor(T_world_camera, device=sources.feature.device, dtype=torch.float32)
    rays_per_chunk = chunk_size(rays_per_chunk, pose.device, sampling)

    def trace(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> None:
        for start in range(0, len(rows), rays_per_chunk):
            v, u = rows[start : start + rays_per_chunk], columns[start : start + rays_per_chunk]
            pixels = torch.from_numpy(np.stack((u, v), axis=1).astype(np.float32)).to(pose.device)
            prior = torch.from_numpy(prior_depth_m[v, u]).to(pose.device)
            near_m, far_m = sampling.near_m, sampling.far_m
            rays = pixel_rays(pixels, intrinsics, pose, near_m=near_m, far_m=far_m, prior_depth_m=prior)
            with torch.inference_mode():
                render = field.render(rays, sources)
                probabilities[v, u] = torch.softmax(render.logits, dim=-1).cpu().numpy()
                known[v, u] = render.known.cpu().numpy()
                depth_m[v, u] = (render.depth_m * render.known).cpu().numpy()

    v, u = (grid.ravel() for grid in np.mgrid[0:height:COARSEST, 0:width:COARSEST])
    trace(v, u)
    traced, step = len(v), COARSEST
    while step > 1:
        doubt = np.zeros((height, width), np.float32)
        half = step // 2
        lines = (len(rgb) + half - 1) // half
        _fill_between(lines, step, probabilities, known, depth_m, prior_depth_m, rgb, doubt)
        flat = np.flatnonzero(doubt)
        left = max(int(share * height * width) - traced, 0)
        if len(flat) > left:
            flat = flat[np.argsort(-doubt.ravel()[flat], kind="stable")[:left]]
        if len(flat):
            trace(*np.unravel_index(np.sort(flat), doubt.shape))
        traced, step = traced + len(flat), step // 2
    return probabilities, known, depth_m, traced


@parallel_kernel()
def _fill_between(start, stop, step, probabilities, known, depth, prior, rgb, doubt):  # pragma: no cover - compiled
    """Give the pixels half way between those of a grid the mean of the known grid pixels round them; in place.

    Fills ``doubt`` (H, W) with how little those tell of such a pixel: 0 = enough.
    """
    width, half = depth.shape[1], step // 2
    for line in range(start, stop):
        v = line * half
        for u in range(0, width, half):
            if v % step > 0 or u % step > 0:
                _fill_pixel(v, u, step, probabilities, known, depth, prior, rgb, doubt)


@kernel()
def _fill_pixel(v, u, step, probabilities, known, depth, prior, rgb, doubt):  # pragma: no cover - compiled
    height, width, classes = probabilities.shape
    count, first, differs = 0, -2, False
    depth_sum, prior_sum, colour_sum = np.float32(0.0), np.float32(0.0), np.zeros(3, np.float32)
    for corner in range(4):
        j = v // step * step if corner < 2 else (v + step - 1) // step * step
        i = u // step * step if corner % 2 == 0 else (u + step - 1) // step * step
        j, i = (j if j < height else j - step), (i if i < width else i - step)
        prior_sum += prior[j, i]
        for c in range(3):
            colour_sum[c] += rgb[j, i, c]
        top = -1
        if known[j, i]:
            count += 1
            depth_sum += depth[j, i]
            top = 0
            for c in range(classes):
                probabilities[v, u, c] += probabilities[j, i, c]
                if probabilities[j, i, c] > probabilities[j, i, top]:
                    top = c
        differs = differs or (first > -2 and top != first)
        first = top
    best = np.float32(0.0)
    if count > 0:
        known[v, u], depth[v, u] = True, depth_sum / count
        for c in range(classes):
            probabilities[v, u, c] /= count
            best = max(best, probabilities[v, u, c])
    jump = abs(prior_sum / 4 - prior[v, u]) > DEPTH_STEP * prior[v, u]
    edge = np.float32(0.0)
    for c in range(3):
        edge += abs(colour_sum[c] / 4 - rgb[v, u, c])
    if differs or jump or edge > COLOUR_STEP or 1 - best > UNSURE:
        doubt[v, u] = (2.0 if differs else 0.0) + (1.0 if jump else 0.0) + min(edge / 255, 1.0) + (1 - best)
