"""Plane sweep over source views, and semi-global matching: the cost of each pixel at each plane, and its best plane."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView
from semantic_mapper.geometry import camera_matrix, invert_pose
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int32, Int64, UInt8

SMALL_STEP, LARGE_STEP = 8, 80  # P1 and P2; costs are sums of two numbers of different bits of 24
EDGE_GRAY = 16.0  # a difference of gray by which P2 halves
# Of a plane that no source sees. A pixel that matches nowhere costs some 20 by chance, and near planes leave the
# picture of a source first: a higher cost would push plain surfaces away.
UNSEEN_COST = 14
# Of a plane far from the hint. More helps a right hint, but a wrong one then outweighs what the pictures show.
HINT_COST = 3.0
PATH_GROUPS = 3  # paths to the sides, down and up
# P2 by the difference of gray: depth leaps where the image has an edge.
_LARGE_STEPS = np.maximum(LARGE_STEP / (1 + np.arange(256) / EDGE_GRAY), 2 * SMALL_STEP).astype(np.int16)

Int16 = NDArray[np.int16]
UInt16 = NDArray[np.uint16]
T = TypeVar("T", bound=np.generic)


class SweepResult(NamedTuple):
    """What matching found of each pixel of the reference."""

    cost: UInt8  # (h, w, D) uint8 matching cost of each plane
    path_sum: UInt16  # (h, w, D) uint16 the same, summed along paths
    plane: Float32  # (h, w) float32 best plane, between planes
    confidence: Float32  # (h, w) float32 in [0, 1], how much the next best plane costs above it
    seen: UInt8  # (h, w) uint8 the most sources that see one plane of the pixel


def inverse_depths(planes: int, near_m: float, far_m: float) -> Float32:
    """Inverse depth (D,) of each plane, from far to near in equal steps."""
    return np.linspace(1 / far_m, 1 / near_m, planes, dtype=np.float32)


def sweep_and_match(
    reference: PreparedView, sources: Sequence[PreparedView], inverse_depth: Float32, hint: DepthEstimate | None
) -> SweepResult:
    """Find the plane of each pixel of ``reference`` by its ``sources`` (at least one).

    D of ``inverse_depth`` (D,) is a multiple of 16, at most 256. The hint, at the reference's size, holds where nothing
    contradicts it.
    """
    height, width = reference.gray.shape
    volume = (height, width, len(inverse_depth))
    cost, seen = np.empty(volume, np.uint8), np.empty((height, width), np.uint8)
    ways = relative_projections(reference, [(s.intrinsics_double, s.T_world_camera) for s in sources])
    stacked = stack_images([s.census for s in sources], np.int32)
    hints = _hint_planes(hint, inverse_depth, (height, width))
    census = reference.census
    sweep_planes(height, census, *stacked, *ways, inverse_depth, *hints, cost, seen, UNSEEN_COST, HINT_COST)
    total = np.empty((PATH_GROUPS, *volume), np.uint16)
    states = np.empty((PATH_GROUPS, 2 * (6 * width + 1) * (volume[2] + 4)), np.uint8)
    sum_paths(PATH_GROUPS, cost, reference.gray, _LARGE_STEPS, total, states, SMALL_STEP)
    plane, confidence = (np.empty((height, width), np.float32) for _ in range(2))
    pick_planes(height, total, plane, confidence)
    return SweepResult(cost, total[0], plane, confidence, seen)


def relative_projections(
    reference: PreparedView, targets: Sequence[tuple[CameraIntrinsics, Float64]]
) -> tuple[Float32, Float32]:
    """How the reference's pixels fall into other views, given as intrinsics and pose: (n, 3, 3) and (n, 3) float32, so
    that ``rotation @ (x, y, 1) + translation / z`` is the other's homogeneous pixel of a point at depth z."""
    inverse = np.linalg.inv(camera_matrix(reference.intrinsics))
    rotation, translation = np.empty((len(targets), 3, 3), np.float32), np.empty((len(targets), 3), np.float32)
    for n, (intrinsics, T_world_camera) in enumerate(targets):
        T_other_reference = invert_pose(T_world_camera) @ reference.T_world_camera
        rotation[n] = camera_matrix(intrinsics) @ T_other_reference[:3, :3] @ inverse
        translation[n] = camera_matrix(intrinsics) @ T_other_reference[:3, 3]
    return rotation, translation


def stack_images(images: Sequence[NDArray[T]], dtype: type[T]) -> tuple[NDArray[T], Int64]:
    """Images (H, W) of any sizes as one array (n, H, W), with margins to the right and below; their sizes (n, 2)."""
    sizes = np.array([image.shape for image in images], np.int64).reshape(-1, 2)
    if not len(images):
        return np.zeros((0, 1, 1), dtype), sizes
    stacked = np.zeros((len(images), *sizes.max(axis=0)), dtype)
    for out, image in zip(stacked, images, strict=True):
        out[: image.shape[0], : image.shape[1]] = image
    return stacked, sizes


def _hint_planes(hint: DepthEstimate | None, inverse_depth: Float32, size: tuple[int, int]) -> tuple[Float32, Float32]:
    """The plane (h, w) that the hint says, -1 = none, and 1 / planes by which it may be off."""
    if hint is None:
        return np.full(size, -1, np.float32), np.zeros(size, np.float32)
    step = float(inverse_depth[1] - inverse_depth[0])
    known = hint.depth_m > 0
    depth = np.where(known, hint.depth_m, 1.0)
    plane = np.where(known, (1 / depth - inverse_depth[0]) / step, -1)
    off = 3 * hint.sigma_m / depth**2 / step + 2  # three sigma, and two planes for what a map cannot know
    return np.clip(plane, -1, len(inverse_depth) - 1).astype(np.float32), (1 / off).astype(np.float32)


@parallel_kernel()
def sweep_planes(
    count: int,
    census: Int32,
    source_census: Int32,
    source_size: Int64,
    rotation: Float32,
    translation: Float32,
    inverse_depth: Float32,
    hint: Float32,
    hint_rate: Float32,
    cost: UInt8,
    seen: UInt8,
    unseen: int,
    hint_cost: float,
) -> None:
    """Cost of each plane of each pixel: of its two best sources, twice that of a single one, plus what the hint costs.

    Writes ``cost`` (h, w, D) and ``seen`` (h, w). Of ``census`` (2h, 2w) of the reference every second pixel is used;
    ``source_census`` are (n, H, W), projections lead to their pixels and are truncated; ``hint`` and ``hint_rate``
    (h, w) are a plane, < 0 = none, and 1 / planes by which it may be off.
    """


@parallel_kernel(chunks_per_thread=PATH_GROUPS)
def sum_paths(
    count: int, cost: UInt8, gray: UInt8, large_step: Int16, path_sum: UInt16, buffer: UInt8, small_step: int
) -> None:
    """Semi-global matching along 8 paths, in 3 groups: to the sides, down, up; writes ``path_sum`` (3, h, w, D).

    ``large_step`` (256,) is P2 by difference of gray, ``small_step`` P1, ``buffer`` (3, bytes) for states of the paths.
    """


@parallel_kernel()
def pick_planes(count: int, path_sum: UInt16, plane: Float32, confidence: Float32) -> None:
    """Lowest plane of each pixel with a parabola through its neighbours: writes ``plane`` and ``confidence`` of
    `SweepResult`; the first of ``path_sum`` (3, h, w, D) becomes the sum of all three."""
