"""The streams of frames that a node takes in: what they are, which have ended, and which frames never came."""

import time
from collections.abc import Sequence

import numpy as np

from semantic_mapper.errors import NodeError
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.messages import EndOfStream, StreamInfo
from semantic_mapper.types import Float64


class Streams:
    """Camera nodes (``count`` of them, each with cameras of its own) whose frames go into one map or one log."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._infos: dict[tuple[str, ...], StreamInfo] = {}
        self._ends: dict[str, EndOfStream] = {}
        self._heard: dict[str, float] = {}

    @property
    def source(self) -> str:
        """Where all frames come from, for people."""
        return " + ".join(info.source for info in self._infos.values())

    @property
    def label_set(self) -> LabelSet | None:
        """Of the label images of all streams; None where label images are missing."""
        return next((info.label_set for info in self._infos.values()), None)

    @property
    def ended(self) -> bool:
        """Whether all have come to their end."""
        return len(self._ends) >= self._count

    @property
    def published(self) -> int:
        """Frames that those that have ended have sent, as they say themselves."""
        return sum(end.published for end in self._ends.values())

    @property
    def ended_by(self) -> str:
        """What ended streams early; empty where nothing did."""
        early = [end for end in self._ends.values() if end.reason != "end"]
        return "; ".join(f"{end.source}: {end.detail or end.reason}" for end in early)

    @property
    def ages_s(self) -> dict[str, float]:
        """Seconds since the last frame of each camera, where there are several."""
        now = time.monotonic()
        return {f"frame {camera}": now - heard for camera, heard in self._heard.items()} if len(self._heard) > 1 else {}

    def begin(self, info: StreamInfo) -> bool:
        """A stream says what it is, maybe not for the first time; True where it said something else before.
        ``NodeError`` where its label images are of another label set than those of the streams before it."""
        key = tuple(sorted(info.cameras)) if self._count > 1 else ()
        before = self._infos.get(key)
        others = [other for name, other in self._infos.items() if name != key]
        if others and others[0].label_set != info.label_set:
            raise NodeError(
                f"the frames of '{info.source}' have other classes than those of '{others[0].source}'; frames of one "
                "map have label images of one label set, or none"
            )
        self._infos[key] = info
        return before is not None and before != info

    def note_frame(self, camera_id: str) -> None:
        """A frame has come."""
        self._heard[camera_id] = time.monotonic()

    def knows(self, end: EndOfStream) -> bool:
        """Whether this very end has been heard before: cameras say it again until all have left."""
        return self._ends.get(end.source) == end

    def end(self, end: EndOfStream) -> bool:
        """One has ended; True where all have."""
        self._ends[end.source] = end
        return self.ended


class MissingFrames:
    """Counts the frames that are missing between others by their numbers, camera by camera."""

    def __init__(self) -> None:
        self.missed = 0
        self.restarts = 0  # times that a camera began to count from the start: it was restarted
        self._last: dict[str, int] = {}

    def note(self, camera_id: str, seq: int) -> None:
        """A frame has come."""
        last = self._last.get(camera_id, seq - 1)
        self._last[camera_id] = seq
        self.restarts += seq <= last
        self.missed += max(0, seq - last - 1)


class MapPoses:
    """Where cameras are in the map: of each world of theirs, what the mapper has said of it last.

    A camera that tracks itself begins its own world, which the mapper may have to find in its map first: until it has
    mapped a frame of it, nobody knows where its cameras are.
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
