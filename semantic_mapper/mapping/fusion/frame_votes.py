"""What a caller gives with a frame, checked, and made into votes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import FrameError, ShapeError
from semantic_mapper.geometry import expect_shape
from semantic_mapper.mapping.fusion.allocation import Camera
from semantic_mapper.mapping.fusion.fuse import Votes, make_votes, no_votes
from semantic_mapper.types import CameraIntrinsics, Float32

ProbabilityTable = tuple[Float32, NDArray[np.int32]]  # probabilities (K, L), row of each pixel (H, W), -1 = unknown


def check_depth(depth_m: Float32, intrinsics: CameraIntrinsics, where: str) -> Float32:
    """Depth (H, W) as one piece of memory.

    Raises:
        ShapeError: it does not fit the intrinsics, or is not float32.
    """
    expect_shape(depth_m, f"{intrinsics.height} {intrinsics.width}", f"{where}: depth_m")
    _expect_dtype(depth_m, np.float32, f"{where}: depth_m")
    return np.ascontiguousarray(depth_m)


def probability_table(
    depth: Float32,
    probabilities: Float32,
    known: NDArray[np.bool_] | None,
    rows: NDArray[np.int32] | None,
    classes: int,
    where: str,
) -> ProbabilityTable:
    """Class probabilities and the row of each pixel, however they were given; see ``VoxelMap.integrate``.

    Raises:
        ShapeError: something does not fit the depth (H, W), or is of another dtype.
    """
    size = f"{depth.shape[0]} {depth.shape[1]}"
    _expect_dtype(probabilities, np.float32, f"{where}: probabilities")
    if rows is None:
        expect_shape(probabilities, f"{size} {classes}", f"{where}: probabilities")
        rows = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
        if known is not None:
            expect_shape(known, size, f"{where}: known")
            _expect_dtype(known, np.bool_, f"{where}: known")
            rows[~known] = -1
    else:
        expect_shape(probabilities, f"K {classes}", f"{where}: probabilities")
        expect_shape(rows, size, f"{where}: rows")
        _expect_dtype(rows, np.int32, f"{where}: rows")
        if known is not None or rows.min() < -1 or rows.max() >= len(probabilities):
            raise ShapeError(f"{where}: rows must be -1 ... {len(probabilities) - 1}, and known None")
    return np.ascontiguousarray(probabilities).reshape(-1, classes), np.ascontiguousarray(rows)


def frame_votes(
    depth: Float32,
    table: ProbabilityTable | None,
    camera: Camera,
    depth_max_m: float,
    classes: int,
    where: str,
    trust: Float32 | None = None,
) -> Votes:
    """Votes of a frame, none without a table; each weighs what the depth under it does, where ``trust`` says so.

    Raises:
        FrameError: probabilities that are none.
    """
    if table is None:
        return no_votes(depth.shape[0], depth.shape[1], classes)
    votes, bad = make_votes(*table, depth, camera, depth_max_m)
    if bad:
        raise FrameError(
            f"{where}: {bad} known pixels hold class probabilities that are NaN, negative or do not sum to 1; "
            "give a softmax, or mark the pixels as not known"
        )
    return votes if trust is None or not trust.size else votes._replace(weights=votes.weights * trust)


def trusted_depth(depth: Float32, trust: Float32 | None, where: str) -> tuple[Float32, Float32]:
    """Depth (H, W) without what is not trusted, and its weights as ``fuse_blocks`` takes them.

    Raises:
        ShapeError: the weights do not fit the depth, or are not float32 in 0..1.
    """
    if trust is None:
        return depth, np.empty((0, 0), np.float32)
    expect_shape(trust, f"{depth.shape[0]} {depth.shape[1]}", f"{where}: trust")
    _expect_dtype(trust, np.float32, f"{where}: trust")
    if not ((trust >= 0) & (trust <= 1)).all():
        raise ShapeError(f"{where}: trust must be 0 ... 1 everywhere")
    return np.where(trust > 0, depth, np.float32(0)), np.ascontiguousarray(trust)


def _expect_dtype(array: NDArray[np.generic], dtype: type[np.generic], name: str) -> None:
    if array.dtype != dtype:
        raise ShapeError(f"{name}: expected dtype {np.dtype(dtype).name}, got {array.dtype.name}")
