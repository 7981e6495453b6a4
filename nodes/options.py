"""Options of the nodes, as they stand in launch files. Every default is documented where it is declared."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from semantic_mapper.config import Config, Positive, read_toml

SOURCE_PATTERN = r"^[A-Za-z0-9_.:-]{1,64}\Z"  # of transport/messages.py, which loads what the launcher has no need of
# Of drivers/registry.py and drivers/poses/config.py, for the same reason.
CAMERA_KINDS = ("v4l2", "opencv", "stereo", "oak", "realsense")
POSE_KINDS = ("device", "fixed", "topic", "board", "rgbd", "visual")
POSE_HELP = (
    '"topic" (odometry from a socket), "board" (a printed board), "rgbd" (odometry from depth), "visual" (from '
    'pictures), "fixed" (it never moves)'
)
TRACKING_KINDS = ("oak",)  # cameras that can tell their own pose
ENDPOINT_PATTERN = r"^([a-z]+://.+|)\Z"
ENDPOINT_NAME_PATTERN = r"^([A-Za-z0-9_-][A-Za-z0-9_.-]{0,47}|[a-z]+://.+)\Z"  # a socket of the launch, or an endpoint
NAME_OR_ENDPOINT = r"^([A-Za-z0-9_-][A-Za-z0-9_.-]{0,47}|[a-z]+://.+|)\Z"

Text = Annotated[str, msgspec.Meta(min_length=1)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**31 - 1)]
Names = Annotated[tuple[Text, ...], msgspec.Meta(min_length=1, max_length=64)]
PoseRow = tuple[float, float, float, float]


def check_tracking(camera_kind: str, pose_kind: object) -> None:
    """Refuse (``ValueError``) poses of kind "device" of a camera that does not track itself."""
    if pose_kind == "device" and camera_kind in CAMERA_KINDS and camera_kind not in TRACKING_KINDS:
        raise ValueError(
            f'poses = {{ kind = "device" }}: cameras of kind "{camera_kind}" do not track themselves, and no frame '
            f"would have a pose (only {', '.join(TRACKING_KINDS)} does); use kind = {POSE_HELP}"
        )


class LiveCamera(Config, frozen=True):
    """A camera that is connected, or a video."""

    kind: Text  # of drivers/registry.py: v4l2, opencv, stereo, oak, realsense
    poses: Text | dict[str, Any]  # who knows where the camera is: TOML file, or the same as a table; see drivers/poses
    # the driver's: TOML file, or the same as a table
    config: str | dict[str, Any] = msgspec.field(default_factory=dict)
    id: Annotated[str, msgspec.Meta(pattern=SOURCE_PATTERN)] = "camera"  # what its frames are called
    # Where it sits on the rig that `poses` tells of (T_base_rig, T_world_rig), row by row; empty = by its calibration.
    T_rig_camera: tuple[PoseRow, PoseRow, PoseRow, PoseRow] | None = None
    # A camera that cannot be opened when the node starts is tried again for so long; 0 = until it is there. One that is
    # lost later is waited for without end.
    open_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0

    def __post_init__(self) -> None:
        if self.poses in POSE_KINDS and not Path(str(self.poses)).exists():
            fix = f'poses = {{ kind = "{self.poses}" }}'
            raise ValueError(f'poses = "{self.poses}" names a file that does not exist; for that kind write {fix}')


def table_of(named: str | dict[str, Any], where: str) -> tuple[dict[str, Any], str]:
    """A table of the launch file, or of the file that it names, and what to call it in messages."""
    if isinstance(named, dict):
        return named, where
    return (read_toml(Path(named)), named) if named else ({}, where)


class CameraOptions(Config, frozen=True):
    """Publishes the frames of a log, as if it were a camera, or those of a camera."""

    log: Text | None = None  # the log to play (a folder: the parts of a recording), or ...
    camera: LiveCamera | None = None  # ... the camera; of the options below it knows max_frames and the two times
    mode: Literal["lockstep", "realtime", "fast"] = "lockstep"  # wait for the mapper; keep the recording's time; hurry
    mapper: str = "mapper"  # lockstep: the node whose answers are waited for
    rate: Annotated[float, msgspec.Meta(ge=0.001, le=1000)] = 1.0  # realtime: 2 = twice as fast as recorded
    loop: bool = False  # play the log again and again: stamps and numbers go on, labels come the first time only
    max_frames: Count = 0  # 0 = all
    # How long a mapper that is waited for (lockstep, fast, a video) may take for one frame; the first one compiles.
    ack_timeout_s: Positive = 300.0
    # Where the mapper answers (its `query`), for poses that close loops (`rgbd`): it moves its map with them, if it
    # keeps a history. Empty = nowhere, and no loops are closed: the map could not follow.
    corrections: Annotated[str, msgspec.Meta(pattern=NAME_OR_ENDPOINT)] = ""

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return (self.mapper,) if self.log is not None and self.mode == "lockstep" else ()

    def __post_init__(self) -> None:
        if (self.log is None) == (self.camera is None):
            raise ValueError("name either a log or a camera")

    @property
    def live(self) -> bool:
        """Whether frames come when they come, no matter who listens: only then may a node be away for a moment."""
        return self.camera is not None or self.mode == "realtime"


class MapperOptions(Config, frozen=True):
    """Maps the frames of a camera node."""

    out: Text  # folder for the map, the picture and the summary
    input: Text | Names = "camera"  # whose frames: a node, or several
    # "newest": an unread frame gives way to a newer one. "all": every frame, in order; logs and video files wait for
    # the mapper. A live camera cannot wait: frames that its queue has no room for count as dropped.
    delivery: Literal["newest", "all"] = "newest"
    weights: str = ""  # empty = those that ship with the package
    config: str = ""  # TOML file with settings of the mapper; empty = defaults
    voxel_size_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0  # 0 = what the config says
    depth: Literal["", "auto", "sensor", "computed", "off"] = ""  # where depth comes from; empty = what the config says
    # A saved map, or a folder with one, to go on in, with its settings: frames are held until their place in it is
    # known (30 at most); empty = a new map.
    map: str = ""
    history_frames: Count = 0  # kept on disk for closed loops, where the config does not say how many
    # Also write the map of the moment to ``map.npz`` in ``out`` every n seconds, while mapping goes on: what a killed
    # process leaves. It costs one frame the time to copy what it touches (some 20 ms), and the next ones up to half of
    # a core while it is written. 0 = only at the end.
    save_every_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    # Where questions about the map are answered: a name, or an endpoint (ipc://PATH, tcp://127.0.0.1:PORT; with keys
    # also tcp://0.0.0.0:PORT, for other machines); empty = nowhere. A name stands for a socket among those of the
    # launch, or of this user where the node is started by hand.
    query: Annotated[str, msgspec.Meta(pattern=NAME_OR_ENDPOINT)] = "query"

    # The node of kind "finetuner" whose weights are taken while mapping, if they are better; empty = none.
    learner: str = ""
    # New weights are refused that agree with less than this fraction of what the map is sure of: those that contradict
    # most of it are more often wrong than the map is. 0 = the finetuner's own judgement is enough.
    min_map_agreement: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.4

    # A fixed endpoint next to that of the launch at which its updates and status can be subscribed to: ipc://PATH,
    # tcp://127.0.0.1:PORT, with keys also tcp://0.0.0.0:PORT; empty = none.
    publish: Annotated[str, msgspec.Meta(pattern=ENDPOINT_PATTERN)] = ""

    # Folder of keys (`semantic-mapper keys`): questions and streams are encrypted, for peers alone; empty = none.
    keys: str = ""

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return (*self.cameras, self.learner) if self.learner else self.cameras

    @property
    def cameras(self) -> tuple[str, ...]:
        """Nodes whose frames are mapped."""
        return (self.input,) if isinstance(self.input, str) else self.input


Recorded = Literal["info", "frame", "refused", "status", "map"]


class RecorderOptions(Config, frozen=True):
    """Writes what other nodes publish to a log; loses nothing but what the disk has no room for."""

    out: Text  # the log to write; further parts are called as it is, with -1, -2, ... before the ending
    # The nodes to record: first those with frames (`streams`), whose end ends the recording.
    sources: Names = ("camera", "mapper")
    streams: Annotated[int, msgspec.Meta(ge=1)] = 1  # how many of the sources, from the first on, are cameras
    topics: tuple[Recorded, ...] = ("info", "frame", "refused", "status")  # "map" may be added
    overwrite: bool = False  # replace a log that is there; where there are splits, with all its parts
    source_timeout_s: Positive = 180.0  # how long the others may take to start
    split_mb: Annotated[float, msgspec.Meta(ge=0)] = 0.0  # a new part before one grows beyond this; 0 = any size
    split_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0  # a new part after this many seconds; 0 = any time
    # Where the disk is full: "stop" recording, or "delete-oldest" parts of it
    disk_full: Literal["stop", "delete-oldest"] = "stop"
    reserve_mb: Annotated[float, msgspec.Meta(ge=0)] = 500.0  # so much of the disk is left free: then it counts as full
    # Colour images: "as-sent" (cameras send PNG, which is lossless), "png", or "jpeg", some seven times smaller.
    # Depth is always lossless, packed as differences and zstd.
    rgb: Literal["as-sent", "png", "jpeg"] = "as-sent"
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 92

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return self.sources

    @property
    def cameras(self) -> tuple[str, ...]:
        """Nodes whose frames are recorded."""
        return self.sources[: self.streams]

    def __post_init__(self) -> None:
        if self.streams > len(self.sources):
            raise ValueError(f"streams = {self.streams}: there are {len(self.sources)} sources")
        if self.disk_full == "delete-oldest" and not (self.split_mb or self.split_s):
            raise ValueError('disk_full = "delete-oldest" deletes whole parts: give split_mb or split_s')


class FinetunerOptions(Config, frozen=True):
    """Finetunes the weights of a mapper on labelled keyframes, next to it and within a budget."""

    mapper: str = "mapper"  # the node that uses the weights; its `learner` is this one
    weights: str = ""  # those that the mapper was started with, the very same file; empty = those of the package
    config: str = ""  # TOML file with an OnlineConfig (semantic_mapper/training/online.py); empty = defaults
    # Where labelled keyframes come from: a name or an endpoint, at which a labelling tool, a teacher network or
    # `semantic-mapper label` binds a publisher (topic "keyframe"), for as long as it has something to say.
    labels: Annotated[str, msgspec.Meta(pattern=ENDPOINT_NAME_PATTERN)] = "labels"
    cpu_fraction: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5  # of one core (or of the GPU) that learning may take
    threads: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1  # that it computes with, all together within its fraction
    # How much others go before it, 0 to 19. With 19 (on Linux) it learns only while nobody else wants the core; where
    # others want all of every core all the time, that is a third of a per cent, and 18 some two per cent.
    niceness: Annotated[int, msgspec.Meta(ge=0, le=19)] = 19
    # The mapper's `out`: restarted, it finds the weights that the mapper keeps there, and in the folder `learning`
    # the labelled keyframes that it has kept itself; empty = begin with neither.
    out: str = ""

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return (self.mapper,)


class FoxgloveOptions(Config, frozen=True):
    """Serves images, map and status to Foxglove, while nobody else wants the processor.

    Its protocol knows neither keys nor passwords, so it listens on 127.0.0.1 alone.
    """

    input: Text | Names = "camera"  # whose frames: a node, or several
    mapper: str = "mapper"  # the node that maps them
    query: Annotated[str, msgspec.Meta(pattern=ENDPOINT_NAME_PATTERN)] = "query"  # the mapper's
    refresh_s: Annotated[float, msgspec.Meta(ge=0.1)] = 2.0  # between two maps, at least; one is sent where it changed
    keys: str = ""  # the mapper's
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 8765  # 0 = any that is free

    def inputs(self) -> tuple[str, ...]:
        """Nodes that it listens to."""
        return (*self.cameras, self.mapper)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Nodes whose frames are handed on."""
        return (self.input,) if isinstance(self.input, str) else self.input


NodeOptions = CameraOptions | MapperOptions | RecorderOptions | FinetunerOptions | FoxgloveOptions
OPTIONS: dict[str, type[NodeOptions]] = {
    "camera": CameraOptions,
    "mapper": MapperOptions,
    "recorder": RecorderOptions,
    "finetuner": FinetunerOptions,
    "foxglove": FoxgloveOptions,
}


class NodeJob(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the launcher tells a node, as JSON, in its one argument or in the open file that this names (``fd:N``).

    A node that is started by hand needs ``{"name": ..., "options": {...}}`` only; endpoints default to those of this
    user, and nobody watches over it.
    """

    name: str
    options: dict[str, Any]
    endpoints: dict[str, str] = msgspec.field(default_factory=dict)  # by node name
    subscribers: Count = 1  # a camera waits for this many before its first frame
    heartbeat_fd: int = -1  # where to tell that it lives; -1 = nowhere
    restarts: Count = 0  # how often it was restarted
    restartable: bool = False  # it restarts where it fails: its failure is no end of its stream
    folder: str = ""  # of the launch; a node leaves notes there for the process that replaces it
