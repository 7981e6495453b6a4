"""A building: procedural rooms side by side, and a long walk that visits one after the other and comes back.

Each room stands in a square cell of its own, with what its opening shows of the next one, so that no two rooms share a
voxel. Rooms are not joined: the walk is cut between one room and the next, as if the robot had gone through the wall.
A mapper of posed frames does not mind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil, sqrt

import numpy as np

from research.scenes.config import TRAIN_SEEDS, CameraPathConfig, NoiseConfig, RoomConfig
from research.scenes.sequence import room_frames
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

BEYOND_M = 3.0  # at most, to each side of a room: its walls and what an opening shows
GAP_M = 1.0  # between two cells: more than a truncation band and a block of voxels


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """One stay in one room.

    Args:
        number: Of the visit, from 0.
        room: Which of the building's rooms, from 0; its seed is the one of that number in ``TRAIN_SEEDS``.
        returning: The walk has been here before; it takes the same way through the room again.
        low, high: (3,) float64 corners of the room's cell, world, metres.
        frames: Of this visit, rendered as they are requested; may be gone through once.
    """

    number: int
    room: int
    returning: bool
    low: Float64
    high: Float64
    frames: Iterator[PosedFrame]


def building_walk(
    rooms: int,
    frames_a_room: int,
    intrinsics: CameraIntrinsics,
    *,
    returns: int = 0,
    hz: float = 15.0,
    room: RoomConfig = RoomConfig(),
    path: CameraPathConfig = CameraPathConfig(),
    noise: NoiseConfig | None = None,
) -> Iterator[Visit]:
    """Visit ``rooms`` rooms in turn, then the first ``returns`` of them again; everything follows from the arguments.

    Only the scene of the present visit is held. Stamps and numbers of the frames go on from visit to visit. Raises
    ConfigError: counts or a rate that make no walk.

    Args:
        rooms: N, on a square grid of cells.
        frames_a_room: Of each visit.
        intrinsics: Of the camera.
        returns: Visits at the end, to the rooms left longest ago; at most N.
        hz: Frames a second, for the stamps.
        room, path, noise: As for ``room_frames``.
    """
    if rooms < 1 or frames_a_room < 1 or not 0 <= returns <= rooms or not hz > 0:
        raise ConfigError(
            "building: need rooms >= 1, frames_a_room >= 1, 0 <= returns <= rooms and hz > 0, got "
            f"{rooms}, {frames_a_room}, {returns} and {hz}"
        )
    for number, index in enumerate((*range(rooms), *range(returns))):
        low, high = room_cell(index, rooms, room)
        own = room_frames(TRAIN_SEEDS[index], frames_a_room, intrinsics, room=room, path=path, noise=noise)
        offset = np.array([low[0] + BEYOND_M, low[1] + BEYOND_M, 0.0])
        yield Visit(number, index, number >= rooms, low, high, _moved(own, offset, number * frames_a_room, hz))


def room_cell(index: int, rooms: int, room: RoomConfig = RoomConfig()) -> tuple[Float64, Float64]:
    """Corners (3,) of the cell of one of ``rooms`` rooms, world, metres; cells are ``GAP_M`` apart."""
    side = room.max_side_m + 2 * BEYOND_M
    row, column = divmod(index, ceil(sqrt(rooms)))
    x, y = column * (side + GAP_M), row * (side + GAP_M)
    return np.array([x, y, -GAP_M]), np.array([x + side, y + side, room.max_height_m + GAP_M])


def _moved(frames: Iterator[PosedFrame], offset: Float64, first: int, hz: float) -> Iterator[PosedFrame]:
    """Frames of one room, moved by ``offset`` (3,), counted from ``first``."""
    for seq, frame in enumerate(frames, start=first):
        T_world_camera = frame.T_world_camera.copy()
        T_world_camera[:3, 3] += offset
        stamp_ns = round((seq + 1) * 1e9 / hz)
        yield replace(frame, seq=seq, stamp_ns=stamp_ns, camera_id="building", T_world_camera=T_world_camera)
