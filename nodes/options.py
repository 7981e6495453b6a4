"""Options of the nodes, as they stand in launch files. Every default is documented where it is declared."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from semantic_mapper.config import Config

Text = Annotated[str, msgspec.Meta(min_length=1)]
Count = Annotated[int, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class CameraOptions(Config, frozen=True):
    """Plays a log as if it were a camera."""

    log: Text  # the log to play
    mode: Literal["lockstep", "realtime", "fast"] = "lockstep"  # wait for the mapper; keep the recording's time; hurry
    mapper: str = "mapper"  # lockstep: the node whose answers are waited for
    rate: Positive = 1.0  # realtime: 2 = twice as fast as recorded
    max_frames: Count = 0  # 0 = all
    subscriber_timeout_s: Positive = 180.0  # how long the others may take to start
    ack_timeout_s: Positive = 300.0  # lockstep: how long the mapper may take for one frame; the first one compiles

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return (self.mapper,) if self.mode == "lockstep" else ()


class MapperOptions(Config, frozen=True):
    """Maps the frames of a camera node."""

    out: Text  # folder for the map, the picture and the summary
    input: str = "camera"  # the node whose frames are mapped
    delivery: Literal["newest", "all"] = "newest"  # live: an unread frame gives way to a newer one; all: nothing lost
    weights: str = ""  # empty = those that ship with the package
    config: str = ""  # TOML file with settings of the mapper; empty = defaults
    voxel_size_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0  # 0 = what the config says
    eval_exclude: str = ""  # weights whose finetuning frames are left out of the scores, too
    rerun: str = ""  # write a Rerun recording there; empty = none
    # Also write the map of the moment to ``map.npz`` in ``out`` every so many seconds, beside mapping: what a killed
    # process leaves. It costs one frame the time to copy what it touches (some 20 ms), and the next ones up to half of
    # a core while it is written. 0 = only at the end.
    save_every_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    # Where questions about the map are answered: a name, or an endpoint (ipc://PATH, tcp://127.0.0.1:PORT); empty =
    # nowhere. A name stands for a socket among those of the launch, or of this user where the node is started by hand.
    query: Annotated[str, msgspec.Meta(pattern=r"^([A-Za-z0-9_-][A-Za-z0-9_.-]{0,47}|[a-z]+://.+|)\Z")] = "query"

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return (self.input,)


class RecorderOptions(Config, frozen=True):
    """Writes what other nodes publish to a log; loses nothing."""

    out: Text  # the log to write
    # The nodes to record: first the one with the frames, whose end ends the recording.
    sources: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)] = ("camera", "mapper")
    topics: tuple[str, ...] = ("info", "frame", "refused", "status")  # "map" may be added
    overwrite: bool = False  # replace a log that is there
    source_timeout_s: Positive = 180.0  # how long the others may take to start

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return self.sources


NodeOptions = CameraOptions | MapperOptions | RecorderOptions
OPTIONS: dict[str, type[CameraOptions] | type[MapperOptions] | type[RecorderOptions]] = {
    "camera": CameraOptions,
    "mapper": MapperOptions,
    "recorder": RecorderOptions,
}


class NodeJob(Config, frozen=True):
    """What the launcher tells a node, as JSON, in its one argument.

    A node that is started by hand needs ``{"name": ..., "options": {...}}`` only; endpoints default to those of this
    user, and nobody watches over it.
    """

    name: str
    options: dict[str, Any]
    endpoints: dict[str, str] = msgspec.field(default_factory=dict)  # by node name
    subscribers: Count = 1  # a camera waits for so many before its first frame
    heartbeat_fd: int = -1  # where to tell that it lives; -1 = nowhere
    orphan_s: Count = 120  # without its launcher, it has so many seconds to write its results
