"""What a voxel map gives out: plain data, and which thing each voxel of a refined map belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.types import Bool, Float32, Float64, UInt8

_COORDINATE_BITS, _HALF_RANGE = (
    21,
    1 << 20,
)  # of a packed coordinate: blocks lie within +-2^17
# By stamp_ns, or by (camera_id, stamp_ns) where cameras share stamps: T_world_camera (4, 4).
CorrectedPoses = Mapping[int, Float64] | Mapping[tuple[str, int], Float64]
ALWAYS = 2**63 - 1  # later than any stamp


@dataclass(frozen=True, slots=True)
class CorrectionStatus:
    """Where corrections stand.

    Args:
        running: A rebuild is under way; the map in use is still the old one.
        done, total: Frames of the history that the rebuild has gone through, and all.
        disk_bytes: Of the history's frames.
        completed: Corrections that are in the map in use.
        poses: Given by these, all together.
        frozen: Frames that have left the history; corrections do not reach them.
        lost: Frames that could not be read from disk again, and so are in the map no more after a rebuild.
        failure: Why the last correction was given up; empty where it was not.
    """

    running: bool
    done: int
    total: int
    disk_bytes: int
    completed: int
    poses: int
    frozen: int
    lost: int
    failure: str

    @property
    def left(self) -> int:
        """Frames that the rebuild has still to go through."""
        return self.total - self.done if self.running else 0


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """N points of the fused surface.

    Args:
        xyz: (N, 3) float32 metres in the world.
        rgb: (N, 3) uint8.
        label: (N,) uint8 class ids, the label set's ignore id where nothing voted or the map is too unsure
            (``voxel_map.unknown_below``).
        confidence: (N,) float32 probability of the likeliest class, 0 where nothing voted.
        measured: (N,) bool, False where no sensor measured the surface: its depth was computed; None = unknown.
    """

    xyz: Float32
    rgb: UInt8
    label: UInt8
    confidence: Float32
    measured: Bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MapMesh:
    """The fused surface as V vertices and F triangles.

    Args:
        vertices: (V, 3) float32 metres in the world.
        faces: (F, 3) int32 vertex indices.
        rgb: (V, 3) uint8.
        label: (V,) uint8 class ids, the ignore id where unknown; see ``MapPoints``.
        confidence: (V,) float32, 0 where nothing voted.
        measured: (V,) bool, False where no sensor measured the surface: its depth was computed; None = unknown.
    """

    vertices: Float32
    faces: NDArray[np.int32]
    rgb: UInt8
    label: UInt8
    confidence: Float32
    measured: Bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """The map seen from a pose.

    Args:
        depth_m: (H, W) float32 z-depth, 0 where the ray meets no surface.
        rgb: (H, W, 3) uint8.
        label: (H, W) uint8 class ids, the ignore id at misses and where unknown; see ``MapPoints``.
        confidence: (H, W) float32, 0 at misses and where nothing voted.
        measured: (H, W) bool, False where no sensor measured the surface: its depth was computed; None = unknown.
    """

    depth_m: Float32
    rgb: UInt8
    label: UInt8
    confidence: Float32
    measured: Bool | None = None


def computed_fraction(surface: MapPoints | MapMesh) -> float:
    """Fraction of the points, or vertices, whose depth no sensor measured; 0 of none, and where it is unknown."""
    measured = surface.measured
    return 0.0 if measured is None or not len(measured) else float(1 - measured.mean())


@dataclass(frozen=True, slots=True, eq=False)
class InstanceLayer:
    """Voxels that belong to things; others belong to none.

    Args:
        packed: (N,) int64 ascending, of ``pack_voxels``.
        number: (N,) int32 from 0, the same for all voxels of a thing; those of a thing have one class.
    """

    packed: NDArray[np.int64]
    number: NDArray[np.int32]

    def at(self, voxels: NDArray[np.integer]) -> NDArray[np.int64]:
        """The things (M,) that voxels (M, 3) belong to; -1 = none."""
        wanted = pack_voxels(voxels)
        if not len(self.packed):
            return np.full(len(wanted), -1, np.int64)
        row = np.minimum(np.searchsorted(self.packed, wanted), len(self.packed) - 1)
        return np.where(self.packed[row] == wanted, self.number[row], -1).astype(np.int64)

    @property
    def is_sound(self) -> bool:
        """Whether voxels ascend, and things count from 0."""
        return bool((np.diff(self.packed) > 0).all()) and int(self.number.min(initial=0)) >= 0


def instance_layer(voxels: NDArray[np.integer], number: NDArray[np.integer]) -> InstanceLayer:
    """Of unique voxels (N, 3) and the things (N,) they belong to; -1 = none."""
    kept = number >= 0
    packed = pack_voxels(voxels[kept])
    order = np.argsort(packed)
    return InstanceLayer(packed[order], number[kept][order].astype(np.int32))


def pack_voxels(voxels: NDArray[np.integer]) -> NDArray[np.int64]:
    """Keys (N,) of voxel coordinates (N, 3) within +-2^20."""
    shifted = voxels.astype(np.int64) + _HALF_RANGE
    return (shifted[:, 0] << (2 * _COORDINATE_BITS)) | (shifted[:, 1] << _COORDINATE_BITS) | shifted[:, 2]
