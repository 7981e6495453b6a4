"""What a voxel map gives out: plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.types import Bool, Float32, Float64, UInt8

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
