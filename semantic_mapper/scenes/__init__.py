"""Procedural benchmark scenes: seeded furnished rooms with exact depth, labels and poses."""

from semantic_mapper.scenes.building import Visit, building_walk, room_cell
from semantic_mapper.scenes.camera import camera_path
from semantic_mapper.scenes.config import (
    SUITE_VERSION,
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    CameraPathConfig,
    NoiseConfig,
    PoseNoiseConfig,
    RoomConfig,
)
from semantic_mapper.scenes.render import RenderedView, render_view
from semantic_mapper.scenes.room import make_room
from semantic_mapper.scenes.scene import Scene
from semantic_mapper.scenes.sequence import RoomView, room_frames, room_views

__all__ = [
    "SUITE_VERSION",
    "TEST_SEEDS",
    "TRAIN_SEEDS",
    "VALIDATION_SEEDS",
    "CameraPathConfig",
    "NoiseConfig",
    "PoseNoiseConfig",
    "RenderedView",
    "RoomConfig",
    "RoomView",
    "Scene",
    "Visit",
    "building_walk",
    "camera_path",
    "make_room",
    "render_view",
    "room_cell",
    "room_frames",
    "room_views",
]
