"""Two maps of one place laid over each other: blocks and surface that one lacks, other classes, other confidence."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_scale import require_same_scale
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.storage.block_index import pack_keys, unpack_keys
from semantic_mapper.mapping.storage.grid_buffers import BLOCK_SIDE
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float32, Float64

UNKNOWN = "unknown"
COMPARED_AT_ONCE = 256  # blocks


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMatch:
    """The surface of one map beside the nearest of the other.

    Args:
        points: N points of the one.
        label_set: Of its classes.
        distance_m: (N,) float64 to the nearest point of the other; infinite where it has none.
        common: (N,) bool, that is at most ``common_m`` away.
        relabelled: (N,) bool, common, and the nearest point of the other has a class of another name.
        confidence_gap: (N,) float32 absolute difference of confidence, 0 where not common.
        nearest_name: (N,) class name of that point; ``UNKNOWN`` where nothing voted, or nothing is common.
    """

    points: MapPoints
    label_set: LabelSet
    distance_m: Float64
    common: NDArray[np.bool_]
    relabelled: NDArray[np.bool_]
    confidence_gap: Float32
    nearest_name: NDArray[np.str_]

    def share(self, mask: NDArray[np.bool_], of: NDArray[np.bool_] | None = None) -> float:
        """Fraction of the points ``of`` (all without it) that ``mask`` is true for; 0 of none."""
        count = len(mask) if of is None else int(of.sum())
        return float(mask.sum()) / count if count else 0.0

    def percentile_m(self, q: float) -> float | None:
        """Percentile of the distances, None where there are none or the other map has no surface."""
        if not len(self.distance_m) or not np.isfinite(self.distance_m).all():
            return None
        return float(np.percentile(self.distance_m, q))


def match_surfaces(a: VoxelMap, b: VoxelMap) -> tuple[SurfaceMatch, SurfaceMatch]:
    """A's surface beside B's, and B's beside A's. Common is what lies within the larger of their voxels.

    Raises:
        MapError: only one of them is in metres.
    """
    require_same_scale(a.scale_known, b.scale_known, "compare")
    common_m = max(a.config.voxel_size_m, b.config.voxel_size_m)
    of_a, of_b = (a.points(), a.label_set), (b.points(), b.label_set)
    return _match(*of_a, *of_b, common_m), _match(*of_b, *of_a, common_m)


def _match(
    points: MapPoints, label_set: LabelSet, others: MapPoints, other_set: LabelSet, common_m: float
) -> SurfaceMatch:
    count = len(points.xyz)
    distance, nearest = np.full(count, np.inf), np.zeros(count, np.int64)
    if len(others.xyz):
        distance, nearest = cKDTree(others.xyz).query(points.xyz, workers=-1)
    common = distance <= common_m
    mine, theirs = _names(label_set)[points.label], np.full(count, UNKNOWN, _names(other_set).dtype)
    gap = np.zeros(count, np.float32)
    theirs[common] = _names(other_set)[others.label[nearest[common]]]
    gap[common] = np.abs(points.confidence[common] - others.confidence[nearest[common]])
    return SurfaceMatch(points, label_set, distance, common, common & (mine != theirs), gap, theirs)


def label_changes(match: SurfaceMatch, most: int = 10) -> list[tuple[str, str, int]]:
    """Which class became which at the common surface, and at how many points; the most frequent first."""
    names = _names(match.label_set)[match.points.label[match.relabelled]]
    counts = Counter(zip(names.tolist(), match.nearest_name[match.relabelled].tolist(), strict=True))
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return [(mine, theirs, count) for (mine, theirs), count in ordered[:most]]


def _names(label_set: LabelSet) -> NDArray[np.str_]:
    """Class name of each id 0..255."""
    names = dict(zip(label_set.ids, label_set.names, strict=True))
    return np.array([names.get(i, UNKNOWN) for i in range(256)])


@dataclass(frozen=True, slots=True, eq=False)
class BlockMatch:
    """Blocks (B, 3) that one map has alone, and those of both; of maps with voxels of one size.

    Args:
        only_a, only_b, common: int32 block coordinates.
        side_m: Edge of a block.
    """

    only_a: NDArray[np.int32]
    only_b: NDArray[np.int32]
    common: NDArray[np.int32]
    side_m: float

    @property
    def alone(self) -> float:
        """Fraction of all blocks that one map has alone."""
        count = len(self.only_a) + len(self.only_b)
        return count / max(count + len(self.common), 1)


def match_blocks(a: VoxelMap, b: VoxelMap) -> BlockMatch | None:
    """Which blocks both maps have; None where voxels differ in size, so that no block of one is one of the other."""
    if a.config.voxel_size_m != b.config.voxel_size_m:
        return None
    of_a, of_b = _packed(a), _packed(b)
    return BlockMatch(
        only_a=unpack_keys(np.setdiff1d(of_a, of_b, assume_unique=True)),
        only_b=unpack_keys(np.setdiff1d(of_b, of_a, assume_unique=True)),
        common=unpack_keys(np.intersect1d(of_a, of_b, assume_unique=True)),
        side_m=a.config.voxel_size_m * BLOCK_SIDE,
    )


def count_other_bits(a: VoxelMap, b: VoxelMap, common: NDArray[np.int32]) -> int:
    """How many of the blocks (B, 3) that both maps have are not the same to the bit, in whatever they hold."""
    count = 0
    for start in range(0, len(common), COMPARED_AT_ONCE):
        keys = common[start : start + COMPARED_AT_ONCE]
        of_a, of_b = a.block_state(keys), b.block_state(keys)
        other = np.zeros(len(keys), np.bool_)
        for name, values in of_a.items():
            other |= _other_rows(values, of_b[name])
        count += int(other.sum())
    return count


def _other_rows(a: NDArray[np.generic], b: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which rows differ in any bit; all of them where the arrays are not of one kind."""
    if a.dtype != b.dtype or a.shape != b.shape:
        return np.ones(len(a), np.bool_)
    bytes_a, bytes_b = (np.ascontiguousarray(v).view(np.uint8).reshape(len(v), -1) for v in (a, b))
    return (bytes_a != bytes_b).any(axis=1)


def _packed(voxel_map: VoxelMap) -> NDArray[np.int64]:
    with voxel_map.locked() as grid:
        return pack_keys(grid.all_keys())
