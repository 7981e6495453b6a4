"""What a map gives out, and whether its lengths are metres: plain data.

A map of poses from pictures alone has a unit of its own (``VoxelMap.scale_known``). What asks for metres, or states
them, asks here first (``require_metres``); pictures, classes and counts go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.types import Bool, Float32, Float64, UInt8

# By stamp_ns, or by (camera_id, stamp_ns) where cameras share stamps: T_world_camera (4, 4).
CorrectedPoses = Mapping[int, Float64] | Mapping[tuple[str, int], Float64]
ALWAYS = 2**63 - 1  # later than any stamp
SCALE_FIX = (
    "`semantic-mapper scale` takes a known length of the map; or give a scale when the film or recording is imported "
    "(--square-mm, --camera-height or --scale), or to visual odometry (scale, distance_m or camera_height_m)"
)


@dataclass(frozen=True, slots=True)
class CorrectionStatus:
    """Where corrections stand."""

    running: bool  # a rebuild is under way; the map in use is still the old one
    # done, total: Frames of the history that the rebuild has gone through, and all.
    done: int
    total: int
    disk_bytes: int  # of the history's frames
    completed: int  # corrections that are in the map in use
    poses: int  # given by these, all together
    frozen: int  # frames that have left the history; corrections do not reach them
    lost: int  # frames that could not be read from disk again, and so are in the map no more after a rebuild
    failure: str  # why the last correction was given up; empty where it was not

    @property
    def left(self) -> int:
        """Frames that the rebuild has still to go through."""
        return self.total - self.done if self.running else 0


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """Where a frame was taken."""

    camera_id: str
    stamp_ns: int
    T_map_camera: Float64 | None  # (4, 4) float64; None while its place in the map is not known
    reason: str = ""  # why it is not; empty otherwise


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """N points of the fused surface."""

    xyz: Float32  # (N, 3) float32 metres in the world
    rgb: UInt8  # (N, 3) uint8
    # (N,) uint8 class ids, the label set's ignore id where nothing voted or the map is too unsure
    # (``voxel_map.unknown_below``)
    label: UInt8
    confidence: Float32  # (N,) float32 probability of the likeliest class, 0 where nothing voted
    # (N,) bool, False where no sensor measured the surface: its depth was computed; None = unknown
    measured: Bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MapMesh:
    """The fused surface as V vertices (V, 3), float32 metres in the world, and F faces (F, 3), int32 vertex indices.

    The rest is that of the vertices, as of ``MapPoints``."""

    vertices: Float32
    faces: NDArray[np.int32]
    rgb: UInt8
    label: UInt8
    confidence: Float32
    measured: Bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """The map seen from a pose."""

    depth_m: Float32  # (H, W) float32 z-depth, 0 where the ray meets no surface
    rgb: UInt8  # (H, W, 3) uint8
    # label, confidence, measured: (H, W) as of ``MapPoints``; ignore id, 0 and False at misses.
    label: UInt8
    confidence: Float32
    measured: Bool | None = None


def computed_fraction(surface: MapPoints | MapMesh) -> float:
    """Fraction of the points, or vertices, whose depth no sensor measured; 0 of none, and where it is unknown."""
    measured = surface.measured
    return 0.0 if measured is None or not len(measured) else float(1 - measured.mean())


def require_metres(scale_known: bool, what: str) -> None:
    """Refuse what takes or gives metres where the map, or log, has none: ``MapError`` that begins with ``what``."""
    if not scale_known:
        raise MapError(f"{what}: needs metres, but the scale is unknown; {SCALE_FIX}")


def require_same_scale(one_known: bool, other_known: bool, what: str) -> None:
    """Refuse what puts lengths of two maps side by side where only one of them is in metres: ``MapError``."""
    if one_known != other_known:
        raise MapError(f"{what}: one map is in metres, the scale of the other is unknown; {SCALE_FIX}")


def scale_name(scale_known: bool) -> Literal["metres", "unknown"]:
    """What files and answers say."""
    return "metres" if scale_known else "unknown"


def voxel_size_text(size: float, scale_known: bool) -> str:
    """Edge of a voxel, for people."""
    return f"{size * 100:g} cm" if scale_known else f"{size:g} {length_unit(scale_known)}"


def length_unit(scale_known: bool) -> str:
    """Unit of lengths, for people."""
    return "m" if scale_known else "units (scale unknown)"
