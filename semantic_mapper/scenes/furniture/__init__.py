"""Builders of furniture; importing this package fills ``FURNITURE``."""

from semantic_mapper.scenes.furniture import (
    bathroom,
    clutter,
    kitchen,
    seating,
    small,
    storage,
    surfaces,
    varied,
    wall_mounted,
)
from semantic_mapper.scenes.furniture.registry import FURNITURE, Furniture, furniture

__all__ = [
    "FURNITURE",
    "Furniture",
    "bathroom",
    "clutter",
    "furniture",
    "kitchen",
    "seating",
    "small",
    "storage",
    "surfaces",
    "varied",
    "wall_mounted",
]
