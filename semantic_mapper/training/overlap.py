"""How much labelled views see of each other: views that share nothing with a query teach nothing about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from semantic_mapper.geometry import transform, unproject
from semantic_mapper.training.views import LabelledView
from semantic_mapper.types import Float32, Float64
from semantic_mapper.view_selection import GUESSED_DEPTHS_M, visible_points

PROBE = 24  # pixels a row of a view that are asked what the others see of them


def view_overlap(views: Sequence[LabelledView]) -> torch.Tensor:
    """Fraction of what each view sees that each other view sees, too.

    Args:
        views: n views, on the CPU or elsewhere.

    Returns:
        (n, n) float32 in [0, 1]; row = the view that is asked about, column = the one that looks; 0 on the diagonal.
    """
    overlap = torch.zeros(len(views), len(views))
    poses = [view.T_world_camera.cpu().numpy().astype(np.float64) for view in views]
    depths = [view.depth_m.cpu().numpy() for view in views]
    for i, view in enumerate(views):
        points, measured = _points(poses[i], depths[i], view)
        for j, other in enumerate(views):
            if i != j:
                seen = visible_points(points, poses[j], other.intrinsics, depths[j], measured=measured)
                overlap[i, j] = float(seen.mean())
    return overlap


def _points(pose: Float64, depth_m: Float32, view: LabelledView) -> tuple[Float64, bool]:
    """World points (P, 3) of a thinned-out view, and whether they are its measured surface or where it might be."""
    step = max(1, view.intrinsics.width // PROBE)
    unit = unproject(np.ones_like(depth_m), view.intrinsics)[step // 2 :: step, step // 2 :: step].reshape(-1, 3)
    depth = depth_m[step // 2 :: step, step // 2 :: step].reshape(-1).astype(np.float64)
    if not (depth > 0).any():
        return transform(pose, np.concatenate([unit * z for z in GUESSED_DEPTHS_M])), False
    return transform(pose, unit[depth > 0] * depth[depth > 0, None]), True
