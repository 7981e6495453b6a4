"""How much labelled views see of each other: views that share nothing with a query teach nothing about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from semantic_mapper.geometry import invert_pose, nearest_pixels, transform, unproject
from semantic_mapper.training.views import LabelledView
from semantic_mapper.types import Float64

PROBE = 24  # pixels a row of a view that are asked what the others see of them
SAME_SURFACE = 0.05  # share of z by which two views' depths of one surface may differ
UNKNOWN_DEPTHS_M = (0.7, 1.5, 3.0)  # where the surface of a view without depth is put


def view_overlap(views: Sequence[LabelledView]) -> torch.Tensor:
    """Share of what each view sees that each other view sees, too.

    Args:
        views: n views, on the CPU or elsewhere.

    Returns:
        (n, n) float32 in [0, 1]; row = the view that is asked about, column = the one that looks; 0 on the diagonal.
    """
    overlap = torch.zeros(len(views), len(views))
    looks = [_looks(view) for view in views]
    for i, (pose, depth, view) in enumerate(looks):
        points = _points(pose, depth, view)
        for j, (other_pose, other_depth, other) in enumerate(looks):
            if i == j:
                continue
            p = transform(invert_pose(other_pose), points)
            inside, row, column = nearest_pixels(p, other.intrinsics)
            measured = other_depth[row, column]
            # A hole hides nothing; nor is anything known to be hidden from or by a surface that was guessed.
            same = (measured <= 0) | (np.abs(measured - p[:, 2]) < SAME_SURFACE * p[:, 2])
            overlap[i, j] = float((inside & same).mean())
    return overlap


def _looks(view: LabelledView) -> tuple[Float64, np.ndarray, LabelledView]:
    return view.T_world_camera.cpu().numpy().astype(np.float64), view.depth_m.cpu().numpy(), view


def _points(pose: Float64, depth_m: np.ndarray, view: LabelledView) -> Float64:
    """World points (P, 3) of a thinned-out view: its surface, or where it might be."""
    step = max(1, view.intrinsics.width // PROBE)
    unit = unproject(np.ones_like(depth_m), view.intrinsics)[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    depth = depth_m[step // 2 :: step, step // 2 :: step].reshape(-1).astype(np.float64)
    if not (depth > 0).any():
        return transform(pose, np.concatenate([unit * z for z in UNKNOWN_DEPTHS_M]))
    return transform(pose, unit[depth > 0] * depth[depth > 0, None])
