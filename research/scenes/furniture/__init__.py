"""Builders of furniture; importing this package fills ``FURNITURE``."""

from research.scenes.furniture import (
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
from research.scenes.furniture.registry import FURNITURE, Furniture, furniture

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
