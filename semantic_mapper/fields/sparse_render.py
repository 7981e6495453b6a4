"""Render a view with fewer rays: every second pixel of every second row, then those where that does not tell enough.

Between rays that say the same of the same surface there is nothing to find; at borders of classes and of depth, and
where the field is in doubt, there is.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped, and so is what is compiled.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUntypedFunctionDecorator=false
import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.base import EncodedViews, SemanticField
from semantic_mapper.geometry import pixel_rays
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

DEPTH_STEP = 0.05  # share of z by which depth priors of neighbours differ across a border
UNSURE = 0.2  # probability that is not the likeliest class's, above which agreeing rays do not tell enough


def render_sparse_view(
    field: SemanticField,
    sources: EncodedViews,
    intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
    prior_depth_m: Float32,
    sampling: SamplingConfig,
    rays_per_chunk: int,
    refine: float,
) -> tuple[Float32, NDArray[np.bool_], Float32, int]:
    """As ``render_view``, with a quarter of its rays and at most ``refine`` of the others.

    Args:
        refine: Share of the pixels off the coarse grid that may have rays of their own, the most doubtful first.

    Returns:
        Class probabilities (H, W, L), known (H, W), depth (H, W) in metres, and the number of rays rendered.
    """
    height, width = intrinsics.height, intrinsics.width
    probabilities = np.zeros((height, width, len(field.label_set)), np.float32)
    known, depth_m = np.zeros((height, width), np.bool_), np.zeros((height, width), np.float32)

    def trace(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> None:
        pose = torch.tensor(T_world_camera, device=sources.feature.device, dtype=torch.float32)
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

    v, u = (grid.ravel() for grid in np.mgrid[0:height:2, 0:width:2])
    trace(v, u)
    doubt = np.zeros((height, width), np.float32)
    _fill_between(probabilities, known, depth_m, prior_depth_m, doubt)
    limit = int(refine * (height * width - len(v)))
    order = np.argsort(-doubt, axis=None, kind="stable")[:limit]
    order = order[doubt.ravel()[order] > 0]
    if len(order):
        trace(*np.unravel_index(np.sort(order), doubt.shape))
    return probabilities, known, depth_m, len(v) + len(order)


@parallel_kernel()
def _fill_between(probabilities, known, depth, prior, doubt):  # pragma: no cover - compiled
    """Give pixels off the coarse grid the mean of the known coarse pixels round them; in place.

    Fills ``doubt`` (H, W) with how little those tell of the pixel: 0 = enough.
    """
    height, width, classes = probabilities.shape
    for v in prange(height):
        for u in range(width):
            if v % 2 == 0 and u % 2 == 0:
                continue
            count, first, differs, jump = 0, -2, False, False
            total = np.float32(0.0)
            for corner in range(4):
                j = v // 2 * 2 if corner < 2 else (v + 1) // 2 * 2
                i = u // 2 * 2 if corner % 2 == 0 else (u + 1) // 2 * 2
                j, i = (j if j < height else j - 2), (i if i < width else i - 2)
                jump = jump or abs(prior[j, i] - prior[v, u]) > DEPTH_STEP * prior[v, u]
                top = -1
                if known[j, i]:
                    count += 1
                    total += depth[j, i]
                    top = 0
                    for c in range(classes):
                        probabilities[v, u, c] += probabilities[j, i, c]
                        if probabilities[j, i, c] > probabilities[j, i, top]:
                            top = c
                differs = differs or (first > -2 and top != first)
                first = top
            unsure = np.float32(1.0)
            if count > 0:
                known[v, u], depth[v, u] = True, total / count
                best = np.float32(0.0)
                for c in range(classes):
                    probabilities[v, u, c] /= count
                    best = max(best, probabilities[v, u, c])
                unsure -= best
            if differs or jump or unsure > UNSURE:
                doubt[v, u] = (2.0 if differs else 0.0) + (1.0 if jump else 0.0) + unsure
