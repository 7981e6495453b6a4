"""Procedural rooms as training material, rendered on the fly and kept in a small pool."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from semantic_mapper.config import Config
from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig, room_frames
from semantic_mapper.training.views import LabelledView, view_from_frame
from semantic_mapper.types import CameraIntrinsics

FOCAL_SHARE = 0.69  # focal length over width: an OAK-D at 1280 pixels has 882.5
ASPECT = 0.75


class RoomPoolConfig(Config, frozen=True):
    """How rooms are rendered and how long each is used."""

    width: int = 192
    views: int = 10  # a room
    rooms: int = 48  # kept at a time
    steps_per_room: int = 4  # a new room replaces the oldest after this many steps
    step_m_min: float = 0.08  # way between two views of a room, drawn between these
    step_m_max: float = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class RoomViews:
    """Views of one room."""

    seed: int
    views: tuple[LabelledView, ...]


def render_room(seed: int, config: RoomPoolConfig) -> RoomViews:
    """Render one room's views; everything follows from the seed."""
    generator = torch.Generator().manual_seed(seed)
    u = float(torch.rand(1, generator=generator))
    path = CameraPathConfig(step_m=config.step_m_min + u * (config.step_m_max - config.step_m_min))
    height = round(config.width * ASPECT)
    focal = FOCAL_SHARE * config.width
    intrinsics = CameraIntrinsics(focal, focal, (config.width - 1) / 2, (height - 1) / 2, config.width, height)
    frames = room_frames(seed, config.views, intrinsics, path=path, noise=NoiseConfig())
    return RoomViews(seed, tuple(view_from_frame(f, ROOMS, config.width) for f in frames))


class RoomPool:
    """A ring of rooms; ``draw`` gives one of them and now and then renders a new one.

    Args:
        config: Sizes.
        first_seed: Seed of the first room; the following rooms count up from it.
    """

    def __init__(self, config: RoomPoolConfig, first_seed: int) -> None:
        self._config = config
        self._next_seed = first_seed
        self._rooms: list[RoomViews] = []
        self._draws = 0

    @property
    def rooms_rendered(self) -> int:
        """How many different rooms training has seen."""
        return -(-self._draws // self._config.steps_per_room)

    def draw(self, generator: torch.Generator) -> RoomViews:
        """A random room of the pool; the first draw of every ``steps_per_room`` renders a new one."""
        if self._draws % self._config.steps_per_room == 0:
            self._rooms.append(render_room(self._next_seed, self._config))
            self._next_seed += 1
            del self._rooms[: -self._config.rooms]
        self._draws += 1
        return self._rooms[int(torch.randint(len(self._rooms), (1,), generator=generator))]
