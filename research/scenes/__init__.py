"""Procedural benchmark scenes: seeded furnished rooms with exact depth, labels and poses."""

from research.scenes.building import Visit, building_walk, room_cell
from research.scenes.camera import camera_path
from research.scenes.config import (
    SUITE_VERSION,
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    CameraPathConfig,
    NoiseConfig,
    PoseNoiseConfig,
    RoomConfig,
)
from research.scenes.render import RenderedView, render_view
from research.scenes.room import make_room
from research.scenes.scene import Scene
from research.scenes.sequence import RoomView, room_frames, room_views

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
