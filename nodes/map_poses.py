"""Where cameras are in the map, for nodes that receive frames in the odometry sessions of their cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semantic_mapper.types import Float64


class MapPoses:
    """Knows of each world what the mapper has said of it last.

    A camera that tracks itself begins its own world; the mapper may have to find that in its map first. Until it has
    mapped a frame of a world, nobody knows where cameras of that world are.
    """

    def __init__(self) -> None:
        self._T_map_world: dict[int, Float64] = {}

    def note(self, world: int, T_map_world: Sequence[float] | Float64) -> None:
        """As a map update says it: (4, 4), 16 numbers, or none where it is no motion."""
        self._T_map_world[world] = np.reshape(T_map_world, (4, 4)) if len(T_map_world) else np.eye(4)

    def place(self, world: int, T_world_camera: Sequence[float] | Float64) -> Float64 | None:
        """T_map_camera (4, 4) of a frame; None where its world is not known yet."""
        T_map_world = self._T_map_world.get(world)
        return None if T_map_world is None else T_map_world @ np.reshape(T_world_camera, (4, 4))
