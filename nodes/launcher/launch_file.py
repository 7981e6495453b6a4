"""Launch files: which nodes run, with which options, and who listens to whom."""

import copy
import importlib
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

import semantic_mapper
from semantic_mapper.config import Config, assign, convert_config, load_config, nearest, parse_value, split_assignment
from semantic_mapper.errors import ConfigError, LogError
from semantic_mapper.nodes.options import (
    CAMERA_KINDS,
    ENDPOINT_PATTERN,
    OPTIONS,
    POSE_HELP,
    POSE_KINDS,
    CameraOptions,
    FinetunerOptions,
    FoxgloveOptions,
    LiveCamera,
    MapperOptions,
    NodeOptions,
    RecorderOptions,
    check_tracking,
)
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.launches import STATUS_SOCKET

LAUNCH_FOLDER = Path(semantic_mapper.__file__).parent / "launch_files"  # ``launch/`` of the top level
MAX_NODES = 64  # each is a process
# What a camera without poses in its file has: the source that needs nothing else.
DEFAULT_POSES = {"oak": "device", "realsense": "rgbd", "stereo": "rgbd"}
HISTORY_FRAMES = 3000  # that the map of a camera with closed loops keeps, unless its launch file says how many

Restart = Literal["never", "on-failure"]


class NodeEntry(Config, frozen=True):
    """One process; ``processes.py`` says how its kind is started and stopped."""

    name: str  # unique; also the name of its endpoint
    kind: Literal["camera", "mapper", "recorder", "finetuner", "foxglove"]
    options: dict[str, Any] = msgspec.field(default_factory=dict)  # see nodes/options.py
    restart: Literal[Restart, ""] = ""  # empty = what the launch file says for all
    enabled: bool = True


class LaunchFile(Config, frozen=True, kw_only=True):
    """A launch file as it stands on disk."""

    # A node that gives no sign of life for so long, and neither has had nor wants processor time meanwhile, is killed.
    # One that starts or ends, or is busy, or waits for a processor or a disk, may be silent for half a minute.
    heartbeat_s: Annotated[float, msgspec.Meta(ge=0.5)] = 30.0
    # A fixed endpoint at which the status of all nodes can be subscribed to (`view --status`), next to the one in the
    # folder of sockets: ipc://PATH, tcp://127.0.0.1:PORT, with keys also tcp://0.0.0.0:PORT; empty = none.
    publish: Annotated[str, msgspec.Meta(pattern=ENDPOINT_PATTERN)] = ""
    keys: str = ""  # folder of keys (`semantic-mapper keys`), also for nodes that name none; empty = none
    node: Annotated[tuple[NodeEntry, ...], msgspec.Meta(max_length=MAX_NODES)]
    # Folder of the results, "{out}" in options of nodes. "{now}" stands for the time of the start, such as
    # 20261123T024700Z, with a number where that is there already.
    out: str = "runs/live/{now}"
    # "on-failure": a node that is killed, terminated (SIGTERM of anybody but its launcher), hangs or fails restarts,
    # and the others go on meanwhile; except where it fails by itself before it was ever ready, which the next start
    # would not fix. "never": the launch ends then. A node that is done, such as a log played to its end, stays away.
    restart: Restart = "never"


@dataclass(frozen=True, slots=True)
class Launch:
    """A launch file with every option checked, ready to start."""

    name: str  # of the file
    file: LaunchFile
    nodes: tuple[NodeEntry, ...]  # those that are enabled, with their restart policy
    options: dict[str, NodeOptions]  # by node name, in the order of the file

    def sockets(self) -> tuple[str, ...]:
        """Names of all endpoints: of the nodes, where mappers answer questions and labels come, the launcher's own."""
        others = [o.query for o in self.options.values() if isinstance(o, MapperOptions)]
        others += [o.labels for o in self.options.values() if isinstance(o, FinetunerOptions)]
        return (STATUS_SOCKET, *self.options, *(name for name in others if name and "://" not in name))

    def listeners(self, name: str) -> int:
        """How many nodes subscribe to the frames of a node."""
        kinds = MapperOptions | RecorderOptions | FoxgloveOptions
        return sum(name in o.inputs() for o in self.options.values() if isinstance(o, kinds))


def launch_files() -> dict[str, Path]:
    """Launch files of the package by name ("replay")."""
    return {path.stem: path for path in sorted(LAUNCH_FOLDER.glob("*.toml"))}


def find_launch(path: Path) -> Path:
    """The launch file that ``path`` names, else that of the package which is called so ("replay" or "replay.toml").
    Raises ConfigError: neither is there; lists those of the package."""
    if path.exists() and not path.is_dir():
        return path
    files = launch_files()
    name = path.name.removesuffix(".toml")
    if path.parent != Path() or name not in files:
        what = "is a folder" if path.is_dir() else "no such file"
        raise ConfigError(f"{path}: {what}, and no launch file of the package{nearest(name, list(files))}")
    return files[name]


def load_launch(path: Path, settings: Sequence[str] = (), out: Path | None = None) -> Launch:
    """Read and check a launch file.

    ``settings`` are "NODE.OPTION=VALUE" or "SETTING=VALUE", see ``_override``; ``out`` is the same as "out=DIR". Raises
    ConfigError: unknown key, name or node (with the nearest valid one), a missing value, or one of a wrong type.
    """
    file = load_config(path, LaunchFile)
    names = [n.name for n in file.node]
    for name in names:
        if names.count(name) > 1 or not re.fullmatch(r"[A-Za-z0-9_-]{1,48}", name):
            raise ConfigError(f"{path}: node names must be unique words of letters, digits and _ -, got '{name}'")
    plain = copy.deepcopy(msgspec.to_builtins(file))
    for name, value in sorted(map(split_assignment, settings), key=lambda s: not s[0].endswith(".kind")):
        _override(plain, name, value, path)
    if out is not None:
        _override(plain, "out", str(out), path)
    file = convert_config(plain, LaunchFile, str(path))
    folder = _name_start(file.out)
    nodes = tuple(
        msgspec.structs.replace(n, restart=n.restart or file.restart, options=_fill_in(n.options, folder))
        for n in file.node
        if n.enabled
    )
    _complete_options(nodes)
    launch = Launch(path.name, file, nodes, {n.name: _convert_options(n, file.keys, path) for n in nodes})
    try:
        _check_launch(launch)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    return launch


def _override(plain: dict[str, Any], name: str, text: str, path: Path) -> None:
    """Replace a value of a launch file: of the launch ("out"), or of a node ("mapper.weights").

    A camera's own settings need no further name in between: "camera.kind", "camera.config.fps", "camera.poses.kind".
    A `log` takes the place of a live camera, and is played in the time of its recording then; and the other way round.
    """
    first, *keys = name.split(".")
    nodes = {node["name"]: node for node in plain["node"]}
    settings = [f for f in LaunchFile.__struct_fields__ if f != "node"]
    if not keys and first in settings:
        plain[first] = _typed(text, LaunchFile, first)
        return
    if not keys or first not in nodes:
        known = [*settings, *nodes]
        raise ConfigError(f"{path}: no setting and no node is called '{first}'{nearest(first, known)}")
    node = nodes[first]
    if keys in (["restart"], ["enabled"]):
        node[keys[0]] = _typed(text, NodeEntry, keys[0])
        return
    table, kind = node["options"], OPTIONS[node["kind"]]
    known = [*kind.__struct_fields__, "restart", "enabled"]
    if kind is CameraOptions:
        known += LiveCamera.__struct_fields__
        if keys[0] in LiveCamera.__struct_fields__:
            table.pop("log", None)
            table, kind = table.setdefault("camera", {}), LiveCamera
        elif keys == ["log"]:
            table.pop("camera", None)
            if plain["restart"] != "never":
                table.setdefault("mode", "realtime")
    if keys[0] not in known:
        raise ConfigError(f"{path}: node '{first}' has no option '{keys[0]}'{nearest(keys[0], known)}")
    struct = kind if len(keys) == 1 else _struct_of(keys[-2], table)
    assign(table, ".".join(keys), _typed(text, struct, keys[-1]), f"{path}: node '{first}'")


def _struct_of(key: str, camera: Mapping[str, Any]) -> type[msgspec.Struct] | None:
    """What the table `config` or `poses` of a camera is checked against; None where that is not known."""
    if key == "config" and camera.get("kind") in CAMERA_KINDS:
        return importlib.import_module(f"semantic_mapper.drivers.{camera['kind']}.config").Config
    poses = camera.get("poses")
    if key == "poses" and isinstance(poses, dict):
        return importlib.import_module("semantic_mapper.drivers.poses.config").KINDS.get(poses.get("kind"))
    return None


def _typed(text: str, struct: type[msgspec.Struct] | None, name: str) -> Any:
    """A value as its setting wants it; what is to be a text stays one, whatever it looks like: ids may be numbers."""
    parsed = parse_value(text)
    if isinstance(parsed, str):
        return parsed
    fields = {} if struct is None else {item.encode_name: item.type for item in msgspec.structs.fields(struct)}
    for value in (parsed, text) if isinstance(parsed, list | dict) else (text, parsed):
        with suppress(msgspec.ValidationError):
            if name in fields:
                msgspec.convert(value, fields[name])
                return value
    return parsed


def _name_start(out: str) -> str:
    """The folder of this start: the time, and a number where that is there already, as where the clock is set back."""
    time = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    folders = [out.replace("{now}", name) for name in (time, *(f"{time}-{n}" for n in range(1, 1000)))]
    return next((folder for folder in folders if not os.path.exists(folder)), folders[0])


def _fill_in(value: Any, out: str) -> Any:
    """Replace "{out}" in texts."""
    if isinstance(value, list):
        return [_fill_in(v, out) for v in value]
    if isinstance(value, dict):
        return {k: _fill_in(v, out) for k, v in value.items()}
    return value.replace("{out}", out) if isinstance(value, str) else value


def _complete_options(nodes: Sequence[NodeEntry]) -> None:
    """What options follow from those of other nodes, or from the kind of a camera.

    Cameras that know their poses have them; the map keeps a history where poses close loops; viewers know where their
    mapper answers, and its keys.
    """
    mappers = {node.name: node.options for node in nodes if node.kind == "mapper"}
    for node in nodes:
        live = node.options.get("camera")
        if node.kind == "foxglove":
            mapper = mappers.get(node.options.get("mapper", "mapper"), {})
            node.options.update({name: mapper[name] for name in ("query", "keys") if name in mapper} | node.options)
        if node.kind != "camera" or not isinstance(live, dict):
            continue
        if live.get("kind") in DEFAULT_POSES:
            live.setdefault("poses", {"kind": DEFAULT_POSES[live["kind"]]})
        poses, config = live.get("poses"), live.setdefault("config", {})
        source = poses.get("kind") if isinstance(poses, dict) else None
        if source == "device" and live.get("kind") == "oak" and isinstance(config, dict):
            config.setdefault("odometry", True)
        if source == "rgbd" and "corrections" not in node.options:
            for mapper in mappers.values():
                if mapper.get("input", "camera") == node.name:
                    mapper.setdefault("history_frames", HISTORY_FRAMES)
                    node.options["corrections"] = mapper.get("query", "query")


def _convert_options(node: NodeEntry, keys: str, path: Path) -> NodeOptions:
    where, kind = f"{path}: node '{node.name}'", OPTIONS[node.kind]
    plain = {**({"keys": keys} if keys and "keys" in kind.__struct_fields__ else {}), **node.options}
    for item in msgspec.structs.fields(kind):
        if plain.get(item.encode_name) == "" and (item.required or item.default is None):
            name = f"{node.name}.{item.encode_name}"
            raise ConfigError(f"{where}: needs '{item.encode_name}'; give it with --set {name}=... or in the file")
    if isinstance(camera := plain.get("camera"), dict):
        try:
            _check_camera(camera, node.name)
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from error
    return convert_config(plain, kind, where)


def _check_camera(camera: dict[str, Any], node: str) -> None:
    """Say at once, before a mapper has started, what the camera's own process would refuse much later. Raises
    ValueError: no such kind of camera or of poses, or no poses at all."""
    kind, poses = str(camera.get("kind") or ""), camera.get("poses")
    if kind not in CAMERA_KINDS:
        what = f"`camera.kind`: no kind of camera is called '{kind}'" if kind else "which kind of camera"
        raise ValueError(f"{what}{nearest(kind, CAMERA_KINDS)}; give --set {node}.kind=KIND")
    if not poses:
        raise ValueError(
            "`camera.poses` is missing or empty: a camera alone does not know where it is. Give --set "
            f'{node}.poses.kind=KIND, or in the file poses = {{ kind = "..." }}: {POSE_HELP}, or "device" (OAK)'
        )
    if isinstance(poses, dict):
        source = str(poses.get("kind", ""))
        if source not in POSE_KINDS:
            raise ValueError(f"`camera.poses.kind`: '{source}' is no source of poses{nearest(source, POSE_KINDS)}")
        check_tracking(kind, source)


def _check_launch(launch: Launch) -> None:
    """Whether the nodes fit together.

    Raises ValueError: a node listens to what is not there, or to what is of another kind; there is no camera; two
    cameras of one name, or two endpoints; or a node is to be restarted while a camera waits for others: frames that
    wait for their readers have a result, which a restart would spoil.
    """
    options = launch.options
    cameras = {name: own for name, own in options.items() if isinstance(own, CameraOptions)}
    if not cameras:
        raise ValueError("no node of kind 'camera': nothing would ever happen")
    for name, own in options.items():
        for source in own.inputs():
            if source not in options:
                raise ValueError(f"node '{name}' listens to '{source}', which is no node{nearest(source, [*options])}")
        if isinstance(own, MapperOptions | RecorderOptions | FoxgloveOptions):
            for source in own.cameras:
                if source not in cameras:
                    raise ValueError(f"node '{name}' takes the frames of '{source}', which is no camera")
            _check_camera_ids(name, {source: cameras[source] for source in own.cameras})
        if isinstance(own, FoxgloveOptions) and not isinstance(options[own.mapper], MapperOptions):
            raise ValueError(f"node '{name}' shows the map of '{own.mapper}', which is no mapper")
    restarted = [n.name for n in launch.nodes if n.restart != "never"]
    waiting = [name for name, own in cameras.items() if not own.live]
    if restarted and waiting:
        raise ValueError(
            f"node '{restarted[0]}' is to be restarted, but camera '{waiting[0]}' waits for those who read its "
            f"frames, which would miss some; set {waiting[0]}.mode=realtime, or restart=never"
        )
    sockets = launch.sockets()
    if twice := sorted({name for name in sockets if sockets.count(name) > 1}):
        own = f"'{STATUS_SOCKET}' is the launcher's own"
        raise ValueError(f"{', '.join(twice)}: names two endpoints; give each mapper a `query` of its own ({own})")


def _check_camera_ids(reader: str, cameras: Mapping[str, CameraOptions]) -> None:
    """Raise ``ValueError`` for frames of one name from two cameras, by node name, that node ``reader`` takes."""
    if len(cameras) < 2:
        return
    taken: dict[str, str] = {}
    for node, options in cameras.items():
        for name in _camera_ids(options):
            other = taken.setdefault(name, node)
            if other == node:
                continue
            fix = "give each its own `id`"
            if options.log is not None or cameras[other].log is not None:
                fix = (
                    "frames of a log keep the names that they were recorded under: record one again with another `id`, "
                    "or give each log a mapper of its own; parts of one recording are one node with their folder"
                )
            raise ValueError(f"two cameras of node '{reader}', '{other}' and '{node}', have the id '{name}'; {fix}")


def _camera_ids(options: CameraOptions) -> tuple[str, ...]:
    """Of a camera, or of those in a log; none where the log cannot be read, which its node will say."""
    if options.camera is not None:
        return (options.camera.id,)
    try:
        with open_log(Path(str(options.log))) as log:
            return tuple(log.info.cameras)
    except (LogError, OSError):
        return ()
