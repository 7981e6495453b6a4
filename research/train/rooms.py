"""Procedural rooms as training material, rendered on the fly and kept in a small pool."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from research.scenes import TRAIN_SEEDS, RoomConfig, room_frames
from research.train.cameras import CameraDraw, draw_camera
from research.train.computed_depth import ComputedDepth, compute_depth, draw_computed_depth
from research.train.images import ImageBatch, ImageStepConfig, image_batch
from research.train.room_feed import FeedMaker, open_feed
from research.train.view_draws import cropped_view
from semantic_mapper.config import Config, Fraction
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.imaging import resize_depth, resize_spread, working_intrinsics
from semantic_mapper.labels import ROOMS
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.losses import IGNORE
from semantic_mapper.training.views import LabelledView, mirrored_view, view_from_frame
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame, UInt8

CPU = torch.device("cpu")

_log = get_logger(__name__)


class RoomPoolConfig(Config, frozen=True):
    """How rooms are rendered and how long each is used."""

    width: int = 192
    views: int = 16  # a room, along one path
    rooms: int = 48  # kept at a time
    rooms_at_start: int = 4  # rendered before the first draw
    draws_per_room: int = 6  # a new room replaces the oldest after this many draws
    step_m_min: float = 0.08  # way between two views of a room, drawn between these
    step_m_max: float = 0.35
    people: Fraction = 0.3  # of the rooms with people or animals in them
    variety: Fraction = 0.0  # of the rooms that hold what benchmark rooms lack; see ``RoomConfig.variety``
    # Of the rooms whose views have depth that is computed from their pictures, instead of measured depth. What they are
    # to render to is measured all the same. Needs ``computed_depth`` in [field.encoder].
    computed_depth: Fraction = 0.0
    camera: CameraDraw = CameraDraw()

    def __post_init__(self) -> None:
        if not 1 <= self.rooms_at_start <= self.rooms or self.draws_per_room < 1 or self.views < 2:
            raise ValueError("need 1 <= rooms_at_start <= rooms, draws_per_room >= 1 and views >= 2")
        if not 0 < self.step_m_min <= self.step_m_max or self.width < 16:
            raise ValueError("need 0 < step_m_min <= step_m_max and a width of at least 16")


@dataclass(frozen=True, slots=True, eq=False)
class PackedRoom:
    """V views of one room in as few bytes as they take, as a worker process sends them.

    Args:
        seed: Of the room.
        rgb: (V, 3, H, W) uint8.
        depth_m: (V, H, W) float32, 0 = none.
        channel: (V, H, W) int8 class channels, -1 = ignore.
        intrinsics: Of (H, W).
        T_world_camera: (V, 4, 4) float32.
        computed_m, computed_sigma_m: (V, H, W) float32 depth that was computed from the pictures, and its spread; None
            where views have measured depth alone.
    """

    seed: int
    rgb: UInt8
    depth_m: Float32
    channel: NDArray[np.int8]
    intrinsics: CameraIntrinsics
    T_world_camera: Float32
    computed_m: Float32 | None = None
    computed_sigma_m: Float32 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RoomViews:
    """Views of one room.

    Args:
        seed: Of the room.
        views: In host memory.
        resident: The same views on the training device; the very same objects where that is the CPU.
        labelled: Indices of the views with at least one labelled pixel.
    """

    seed: int
    views: tuple[LabelledView, ...]
    resident: tuple[LabelledView, ...]
    labelled: tuple[int, ...]


def pack_room(seed: int, config: RoomPoolConfig) -> PackedRoom | str:
    """Render one room's views; everything follows from the seed. A room that cannot be made gives the reason."""
    generator = torch.Generator().manual_seed(seed)
    u = float(torch.rand(1, generator=generator))
    step_m = config.step_m_min + u * (config.step_m_max - config.step_m_min)
    computed = draw_computed_depth(seed, config.computed_depth, step_m)
    between = 1 if computed is None else computed.between
    camera = draw_camera(seed, config.width, step_m / between, config.camera)
    how = {
        "room": RoomConfig(people=config.people, variety=config.variety),
        "path": camera.path,
        "noise": camera.noise,
        "pose_noise": camera.pose_noise,
    }
    try:
        frames = list(room_frames(seed, config.views * between, camera.intrinsics, **how))
    except SemanticMapperError as error:
        return f"room {seed}: {error}"
    views = [view_from_frame(f, ROOMS, config.width) for f in frames[::between]]
    return PackedRoom(
        seed,
        np.stack([(v.rgb * 255).round().to(torch.uint8).numpy() for v in views]),
        np.stack([v.depth_m.numpy() for v in views]),
        np.stack([v.channel.numpy().astype(np.int8) for v in views]),
        views[0].intrinsics,
        np.stack([v.T_world_camera.numpy() for v in views]),
        *(_computed_depths(frames, computed, config.width) if computed is not None else (None, None)),
    )


def _computed_depths(frames: Sequence[PosedFrame], how: ComputedDepth, width: int) -> tuple[Float32, Float32]:
    """Depth and spread (V, H, W) of the views among ``frames``."""
    size = working_intrinsics(frames[0].intrinsics, width)
    pairs = [(resize_depth(f, size), resize_spread(f, size)) for f in compute_depth(frames, how)]
    return np.stack([depth for depth, _ in pairs]), np.stack([spread for _, spread in pairs if spread is not None])


def unpack_room(packed: PackedRoom, device: torch.device) -> RoomViews:
    """Views in host memory and on the training device."""
    views = _views_on(packed, CPU)
    resident = views if device.type == "cpu" else _views_on(packed, device)
    labelled = np.flatnonzero((packed.channel != IGNORE).any(axis=(1, 2)))
    return RoomViews(packed.seed, views, resident, tuple(int(i) for i in labelled))


def _views_on(packed: PackedRoom, device: torch.device) -> tuple[LabelledView, ...]:
    """Sent as the bytes they are and unpacked there: a quarter of the way's load."""
    rgb = torch.from_numpy(packed.rgb).to(device).float().div_(255)
    depth = torch.from_numpy(packed.depth_m).to(device)
    channel = torch.from_numpy(packed.channel).to(device).long()
    poses = torch.from_numpy(packed.T_world_camera).to(device)
    computed, spread = (
        None if depths is None else torch.from_numpy(depths).to(device)
        for depths in (packed.computed_m, packed.computed_sigma_m)
    )
    return tuple(
        LabelledView(
            rgb[i],
            depth[i],
            channel[i],
            packed.intrinsics,
            poses[i],
            computed_m=None if computed is None else computed[i],
            computed_sigma_m=None if spread is None else spread[i],
        )
        for i in range(len(packed.rgb))
    )


def render_room(seed: int, config: RoomPoolConfig, device: torch.device = CPU) -> RoomViews:
    """One room; everything follows from the seed. Raises ConfigError: this room cannot be made."""
    packed = pack_room(seed, config)
    if isinstance(packed, str):
        raise ConfigError(packed)
    return unpack_room(packed, device)


class RoomPool(AbstractContextManager["RoomPool"]):
    """A ring of rooms; ``draw`` gives one of them and now and then takes in a new one.

    Which rooms it holds follows from the seed range and the number of draws alone: a pool that starts at draw n is
    the pool that has made n draws, whatever the number of workers. A room that cannot be made leaves its place empty.

    Args:
        config: Sizes.
        first: Place in ``TRAIN_SEEDS`` of the first room.
        stride: Places from one room to the next; ranks that share a range start at different places.
        draws: Draws made before.
        workers: Processes that render ahead; 0 renders inline.
        device: Where ``RoomViews.resident`` lies.
        feed: Makes the rooms.
    """

    def __init__(
        self,
        config: RoomPoolConfig,
        first: int,
        *,
        stride: int = 1,
        draws: int = 0,
        workers: int = 0,
        device: torch.device = CPU,
        feed: FeedMaker = open_feed,
    ) -> None:
        self._config = config
        self._device = device
        self._draws = draws
        self._taken = max(0, self._wanted() - config.rooms)
        self._ring: deque[RoomViews | None] = deque(maxlen=config.rooms)
        self._feed = feed(_seeds(first, stride, self._taken), config, workers)

    @property
    def rooms_rendered(self) -> int:
        """How many different rooms training has seen."""
        return self._wanted()

    @property
    def waited_s(self) -> float:
        """Time spent waiting for rooms."""
        return self._feed.waited_s

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of the rooms that the last draw chose from."""
        return tuple(room.seed for room in self._ring if room is not None)

    def draw(self, generator: torch.Generator) -> RoomViews:
        """A random room of the pool; new ones are taken in first where it is time.

        Raises ConfigError: none of the pool's rooms could be made.
        """
        while self._taken < self._wanted():
            self._take()
        self._draws += 1
        alive = [room for room in self._ring if room is not None]
        if not alive:
            raise ConfigError(f"none of {len(self._ring)} rooms could be made; the reasons are in the log")
        return alive[int(torch.randint(len(alive), (1,), generator=generator))]

    def __exit__(self, *exception: object) -> None:
        self._feed.close()

    def __enter__(self) -> Self:
        return self

    def _wanted(self) -> int:
        """Rooms taken in by the time of the next draw."""
        return self._config.rooms_at_start + self._draws // self._config.draws_per_room

    def _take(self) -> None:
        packed = self._feed.next()
        self._taken += 1
        if isinstance(packed, str):
            _log.warning("room_left_out", reason=packed)
        room = None if isinstance(packed, str) else unpack_room(packed, self._device)
        self._ring.append(room if room is not None and room.labelled else None)


def _seeds(first: int, stride: int, start: int) -> Iterator[int]:
    """Seeds of the places ``start``, ``start + 1``, ...; the range of training seeds is a circle."""
    return (TRAIN_SEEDS[(first + k * stride) % len(TRAIN_SEEDS)] for k in itertools.count(start))


def draw_images(
    rooms: Sequence[RoomViews],
    config: ImageStepConfig,
    generator: torch.Generator,
    device: torch.device,
    *,
    colours_only: bool = False,
) -> ImageBatch:
    """Draw labelled views of each room; all draws are made on the CPU, so they are the same whatever the device.

    Args:
        colours_only: None of them with depth.
    """
    views = []
    for room in rooms:
        order = torch.randperm(len(room.labelled), generator=generator).tolist()[: config.images]
        for place in order:
            view = room.resident[room.labelled[place]]
            mirror = float(torch.rand(1, generator=generator)) < config.mirrored
            view = mirrored_view(view) if mirror else view
            if config.cropped > 0:
                crop, size, down, across = torch.rand(4, generator=generator).tolist()
                view = cropped_view(view, 0.5 + 0.5 * size, down, across) if crop < config.cropped else view
            views.append(view)
    return image_batch(views, config, generator, device, colours_only=colours_only)
