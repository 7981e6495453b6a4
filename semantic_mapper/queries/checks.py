"""Arguments of queries come from people and programs: what is wrong with one is said before anything is computed.

Each check raises ``MapError``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.blocks import KEY_LIMIT
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float64


def as_numbers(values: ArrayLike, name: str) -> Float64:
    """Whatever numpy makes an array of numbers of."""
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise MapError(f"{name}: expected numbers, got {values!r}") from error


def check_points(points: ArrayLike, snapshot: MapSnapshot, name: str = "points") -> Float64:
    """Points (N, 3) in metres, no farther than a map can reach -> units of voxels."""
    require_metres(snapshot.scale_known, name)
    array = np.ascontiguousarray(as_numbers(points, name))
    if array.ndim != 2 or array.shape[1] != 3:
        raise MapError(f"{name}: expected shape (N, 3), got {array.shape}")
    reach_m = 4 * KEY_LIMIT * snapshot.voxel_size_m  # half of what keys can address
    near = (np.abs(array) < reach_m).all(axis=1)
    if not near.all():
        bad = int(np.argmin(near))
        raise MapError(f"{name}: row {bad} is {array[bad].tolist()}; coordinates must be numbers below {reach_m:.0f} m")
    return array / snapshot.voxel_size_m


def check_point(point: ArrayLike, snapshot: MapSnapshot, name: str = "point") -> Float64:
    """One point (3,) in metres -> units of voxels."""
    array = as_numbers(point, name)
    if array.shape != (3,):
        raise MapError(f"{name}: expected shape (3,), got {array.shape}")
    return check_points(array[None], snapshot, name)[0]


def check_direction(direction: ArrayLike, name: str) -> Float64:
    """A direction (3,) or directions (N, 3) of finite length above 0 -> of unit length."""
    array = as_numbers(direction, name)
    if array.ndim not in (1, 2) or array.shape[-1] != 3:
        raise MapError(f"{name}: expected shape (3,) or (N, 3), got {array.shape}")
    length = np.linalg.norm(array, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise MapError(f"{name}: a direction must have a finite length above 0")
    return array / length


def check_up(up: ArrayLike) -> Float64:
    """One direction (3,) -> of unit length."""
    unit = check_direction(up, "up")
    if unit.shape != (3,):
        raise MapError(f"up: expected shape (3,), got {unit.shape}")
    return unit


def check_box(lower: ArrayLike, upper: ArrayLike, snapshot: MapSnapshot) -> tuple[Float64, Float64]:
    """Corners (3,) of a box with volume in metres -> units of voxels."""
    low, high = check_point(lower, snapshot, "lower"), check_point(upper, snapshot, "upper")
    if not (low < high).all():
        raise MapError(
            f"the box from {np.asarray(lower).tolist()} to {np.asarray(upper).tolist()} m is empty; "
            "each coordinate of lower must be below that of upper"
        )
    return low, high


def check_positive(value: float, name: str, most: float = np.inf) -> float:
    """A finite number above 0, and at most so large."""
    if not (np.isfinite(value) and value > 0):
        raise MapError(f"{name} must be a finite number above 0, got {value}")
    if value > most:
        raise MapError(f"{name} must be at most {most:g}, got {value}")
    return float(value)


def rows_in_box(snapshot: MapSnapshot, low: Float64, high: Float64) -> NDArray[np.int64]:
    """Positions in ``packed`` of the blocks with voxels (half a voxel round their centres) in a box of voxel units."""
    first = snapshot.keys.astype(np.float64) * 8
    return np.flatnonzero(((first + 7.5 >= low) & (first - 0.5 <= high)).all(axis=1))
