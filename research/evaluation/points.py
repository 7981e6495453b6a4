"""Labels of the nearest points of another surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, Float64, UInt8


def nearest_points(
    at_xyz: Float32 | Float64, from_xyz: Float32 | Float64, *, max_distance_m: float = 0.05
) -> NDArray[np.int64]:
    """Which (N,) of M points is nearest to each of N others, (N, 3) and (M, 3) in metres; M = none is near enough."""
    if not len(from_xyz) or not len(at_xyz):
        return np.full(len(at_xyz), len(from_xyz), np.int64)
    _, nearest = KDTree(from_xyz).query(at_xyz, distance_upper_bound=max_distance_m, workers=-1)
    return np.asarray(nearest, np.int64)


def nearest_labels(
    at_xyz: Float32, from_xyz: Float32, from_label: UInt8, label_set: LabelSet, *, max_distance_m: float = 0.05
) -> UInt8:
    """Labels (N,) of the nearest of M points, (M, 3) with (M,) ids, at N points; the ignore id where none is near."""
    nearest = nearest_points(at_xyz, from_xyz, max_distance_m=max_distance_m)
    return np.append(from_label, np.uint8(label_set.ignore_id))[nearest]
