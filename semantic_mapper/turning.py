"""Old name of ``image_rotation``."""

from semantic_mapper.image_rotation import rotate_frame as turned_frame
from semantic_mapper.image_rotation import rotate_intrinsics as turned_intrinsics

__all__ = ["turned_frame", "turned_intrinsics"]
