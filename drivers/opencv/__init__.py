"""Whatever else OpenCV reads: video files, and streams by their URL (RTSP, HTTP)."""

from semantic_mapper.drivers.opencv.camera import open_camera
from semantic_mapper.drivers.opencv.config import Config
from semantic_mapper.drivers.registry import FoundCamera

__all__ = ["Config", "list_devices", "open_camera"]


def list_devices() -> list[FoundCamera]:
    """None: files and URLs are named, not found."""
    return []
