"""Builders of furniture; importing this package fills ``FURNITURE``."""

from semantic_mapper.scenes.furniture import bathroom, kitchen, seating, small, storage, surfaces, wall_mounted
from semantic_mapper.scenes.furniture.registry import FURNITURE, Furniture, furniture

__all__ = [
    "FURNITURE",
    "Furniture",
    "bathroom",
    "furniture",
    "kitchen",
    "seating",
    "small",
    "storage",
    "surfaces",
    "wall_mounted",
]
