"""The way of a camera, in memory that does not grow with it."""

from __future__ import annotations

from semantic_mapper.types import Float64

MAX_PATH = 4096  # positions kept of a camera's path; then every other one goes


class CameraPath:
    """A bounded, evenly spread sample of a camera's poses, whatever their number. One thread adds; any may read."""

    def __init__(self) -> None:
        self.poses: list[Float64] = []
        self._seen = -1
        self._stride = 1

    def add(self, T_world_camera: Float64) -> None:
        """The next pose (4, 4)."""
        self._seen += 1
        if self._seen % self._stride == 0:
            self.poses.append(T_world_camera.copy())
        if len(self.poses) > MAX_PATH:
            self.poses = self.poses[::2]
            self._stride *= 2
