"""Arguments of queries come from people and programs: what is wrong with one is said before anything is computed.

Each check raises ``MapError``.
"""

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
    _expect(array, 2, name)
    reach_m = 4 * KEY_LIMIT * snapshot.voxel_size_m  # half of what keys can address
    near = (np.abs(array) < reach_m).all(axis=1)
    if not near.all():
        bad = int(np.argmin(near))
        raise MapError(f"{name}: row {bad} is {array[bad].tolist()}; coordinates must be numbers below {reach_m:.0f} m")
    return array / snapshot.voxel_size_m


def check_point(point: ArrayLike, snapshot: MapSnapshot, name: str = "point") -> Float64:
    """One point (3,) in metres -> units of voxels."""
    array = as_numbers(point, name)
    _expect(array, 1, name)
    return check_points(array[None], snapshot, name)[0]


def check_directions(directions: ArrayLike, name: str) -> Float64:
    """Directions (N, 3), or one (3,), of finite length above 0 -> (N, 3) of unit length."""
    array = np.atleast_2d(as_numbers(directions, name))
    _expect(array, 2, name)
    length = np.linalg.norm(array, axis=1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise MapError(f"{name}: a direction must have a finite length above 0")
    return array / length


def check_up(up: ArrayLike) -> Float64:
    """One direction (3,) -> of unit length."""
    array = as_numbers(up, "up")
    _expect(array, 1, "up")
    return check_directions(array, "up")[0]


def check_box(lower: ArrayLike, upper: ArrayLike, snapshot: MapSnapshot) -> tuple[Float64, Float64]:
    """Corners (3,) of a box with volume in metres -> units of voxels."""
    low, high = check_point(lower, snapshot, "lower"), check_point(upper, snapshot, "upper")
    if not (low < high).all():
        raise MapError(f"the box from {lower} to {upper} m is empty; lower must be below upper along each axis")
    return low, high


def check_positive(value: float, name: str, most: float) -> float:
    """A number above 0, and at most so large."""
    if not 0 < value <= most:  # NaN, too
        raise MapError(f"{name} must be above 0, at most {most:g}, got {value}")
    return float(value)


def _expect(array: Float64, dimensions: int, name: str) -> None:
    if array.ndim != dimensions or array.shape[-1] != 3:
        raise MapError(f"{name}: expected shape {'(3,)' if dimensions == 1 else '(N, 3)'}, got {array.shape}")


def rows_in_box(snapshot: MapSnapshot, low: Float64, high: Float64) -> NDArray[np.int64]:
    """Positions in ``packed`` of the blocks with voxels (half a voxel round their centres) in a box of voxel units."""
    first = snapshot.keys.astype(np.float64) * 8
    return np.flatnonzero(((first + 7.5 >= low) & (first - 0.5 <= high)).all(axis=1))
