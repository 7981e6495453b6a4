"""Whether lengths of a map are metres: what asks for metres, or states them, asks here first.

A map of poses from pictures alone has a unit of its own (``VoxelMap.scale_known``). Snapshots, answers and files of it
say so. What needs no metres goes on: pictures, classes, counts.
"""

from __future__ import annotations

from typing import Literal

from semantic_mapper.errors import MapError

FIX = (
    "give a scale when the film or recording is imported (--distance, --square-mm, --camera-height or --scale), or to "
    "visual odometry (scale, distance_m or camera_height_m), and map it again"
)


def require_metres(scale_known: bool, what: str) -> None:
    """Refuse what takes or gives metres where the map has none.

    Args:
        scale_known: Of the map, or of the log.
        what: Begins the error.

    Raises:
        MapError: lengths of the map are not metres.
    """
    if not scale_known:
        raise MapError(f"{what}: needs metres, but the scale is unknown; {FIX}")


def require_same_scale(one_known: bool, other_known: bool, what: str) -> None:
    """Refuse what puts lengths of two maps side by side where only one of them is in metres.

    Raises:
        MapError: it is so.
    """
    if one_known != other_known:
        raise MapError(f"{what}: one map is in metres, the scale of the other is unknown; {FIX}")


def scale_name(scale_known: bool) -> Literal["metres", "unknown"]:
    """What files and answers say."""
    return "metres" if scale_known else "unknown"


def voxel_size_text(size: float, scale_known: bool) -> str:
    """Edge of a voxel, for people."""
    return f"{size * 100:g} cm" if scale_known else f"{size:g} {length_unit(scale_known)}"


def length_unit(scale_known: bool) -> str:
    """Unit of lengths, for people."""
    return "m" if scale_known else "units (scale unknown)"
