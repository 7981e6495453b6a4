"""Launch files: which nodes run, with which options, and who listens to whom."""

from __future__ import annotations

import copy
import difflib
import importlib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

import semantic_mapper
from semantic_mapper.config import Config, convert_config, load_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.camera.ids import check_camera_ids
from semantic_mapper.nodes.options import (
    CAMERA_KINDS,
    OPTIONS,
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

LAUNCH_FOLDER = Path(semantic_mapper.__file__).parent / "launch_files"  # ``launch/`` of the top level
STATUS_SOCKET = "launch"  # where the launcher publishes how all nodes are
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


class Limits(Config, frozen=True):
    """What a launch file says of the launch as a whole."""

    # A node that gives no sign of life for so long, and neither has had nor wants processor time meanwhile, is killed.
    # One that starts or ends, or is busy, or waits for a processor or a disk, may be silent for half a minute.
    heartbeat_s: Annotated[float, msgspec.Meta(ge=0.5)] = 30.0
    # A fixed endpoint at which the status of all nodes can be subscribed to (`view --status`), next to the one in the
    # folder of sockets: ipc://PATH, tcp://127.0.0.1:PORT, with keys also tcp://0.0.0.0:PORT; empty = none.
    publish: Annotated[str, msgspec.Meta(pattern=r"^([a-z]+://.+|)\Z")] = ""
    keys: str = ""  # folder of keys (`semantic-mapper keys`), also for nodes that name none; empty = none


class LaunchFile(Limits, frozen=True, kw_only=True):
    """A launch file as it stands on disk."""

    node: Annotated[tuple[NodeEntry, ...], msgspec.Meta(max_length=MAX_NODES)]
    # Folder of the results, "{out}" in options of nodes. "{now}" stands for the time of the start, such as
    # 20261123T024700Z, with a number where that is there already.
    out: str = "runs/live/{now}"
    # "on-failure": a node that is killed, terminated (SIGTERM of anybody but its launcher), hangs or fails restarts,
    # and the others go on meanwhile; except where it fails by itself before it was ever ready, which the next start
    # would not fix. "never": the launch ends then. A node that is done, such as a log played to its end, stays away.
    restart: Restart = "never"


class Launch(Limits, frozen=True, kw_only=True):
    """A launch file with every option checked, ready to start.

    ``options`` are by node name, in the order of the file.
    """

    name: str  # of the file
    nodes: tuple[NodeEntry, ...]
    options: dict[str, NodeOptions]

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
    """A launch file: the file that ``path`` names, else that of the package which is called so.

    Args:
        path: Of a file, or a bare name ("replay" or "replay.toml").

    Raises:
        ConfigError: it is a folder, or neither is there; lists those of the package.
    """
    if path.exists() and not path.is_dir():
        return path
    files = launch_files()
    name = path.name.removesuffix(".toml")
    if path.parent == Path() and name in files:
        return files[name]
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; name a launch file in it")
    raise ConfigError(f"{path}: no such file; launch files that come with the package: {', '.join(files)}")


def load_launch(path: Path, settings: Sequence[str] = (), out: Path | None = None) -> Launch:
    """Read and check a launch file.

    Args:
        path: Of the file.
        settings: "NODE.OPTION=VALUE" or "SETTING=VALUE", see ``_Overrides``.
        out: The same as "out=DIR".

    Raises:
        ConfigError: unknown key, name or node (with the nearest valid one), a missing value, or one of a wrong type.
    """
    file = load_config(path, LaunchFile)
    names = [n.name for n in file.node]
    for name in names:
        if names.count(name) > 1 or not re.fullmatch(r"[A-Za-z0-9_-]{1,48}", name):
            raise ConfigError(f"{path}: node names must be unique words of letters, digits and _ -, got '{name}'")
    overrides = _Overrides(file, path)
    for name, value in sorted(map(_parse_setting, settings), key=lambda s: not s[0].endswith(".kind")):
        overrides.apply(name, value)
    if out is not None:
        overrides.apply("out", str(out))
    file = convert_config(overrides.plain, LaunchFile, str(path))
    folder = _name_start(file.out)
    nodes = tuple(
        msgspec.structs.replace(n, restart=n.restart or file.restart, options=_fill_in(n.options, folder))
        for n in file.node
        if n.enabled
    )
    _complete_cameras(nodes)
    _complete_viewers(nodes)
    options = {n.name: _convert_options(n, file.keys, path) for n in nodes}
    for name, own in options.items():
        for source in own.inputs():
            if source not in options:
                raise ConfigError(
                    f"{path}: node '{name}' listens to '{source}', which is no node{_nearest(source, list(options))}"
                )
    _check_restarts(nodes, options, path)
    _check_cameras(options, path)
    limits = {name: getattr(file, name) for name in Limits.__struct_fields__}
    launch = Launch(name=path.name, nodes=nodes, options=options, **limits)
    sockets = launch.sockets()
    if twice := sorted({name for name in sockets if sockets.count(name) > 1}):
        raise ConfigError(
            f"{path}: {', '.join(twice)}: names two endpoints; give each mapper a `query` of its own that is no node "
            f"('{STATUS_SOCKET}' is the launcher's own)"
        )
    return launch


class _Overrides:
    """Values that replace those of a launch file: of the launch ("out"), or of a node ("mapper.weights").

    A camera's own settings need no further name in between: "camera.kind", "camera.config.fps", "camera.poses.kind".
    A `log` takes the place of a live camera, and is played in the time of its recording then; and the other way round.
    """

    def __init__(self, file: LaunchFile, path: Path) -> None:
        self.plain: dict[str, Any] = copy.deepcopy(msgspec.to_builtins(file))
        self._nodes = {node["name"]: node for node in self.plain["node"]}
        self._path = path

    def apply(self, name: str, text: str) -> None:
        """Replace a value.

        Raises:
            ConfigError: nothing is called so; or it belongs into a table that is named as a file.
        """
        first, *keys = name.split(".")
        node = self._nodes.get(first)
        if not keys and first in LaunchFile.__struct_fields__ and first != "node":
            self.plain[first] = _typed(text, _field_type(LaunchFile, first))
        elif node is None or not keys:
            known = [*(f for f in LaunchFile.__struct_fields__ if f != "node"), *self._nodes]
            raise ConfigError(f"{self._path}: no setting and no node is called '{first}'{_nearest(first, known)}")
        elif len(keys) == 1 and keys[0] in ("restart", "enabled"):
            node[keys[0]] = _typed(text, _field_type(NodeEntry, keys[0]))
        else:
            self._set_option(node, keys, text)

    def _set_option(self, node: dict[str, Any], keys: list[str], text: str) -> None:
        table, kind = node["options"], OPTIONS[node["kind"]]
        if kind is CameraOptions and keys[0] in LiveCamera.__struct_fields__:
            table.pop("log", None)
            table, kind = table.setdefault("camera", {}), LiveCamera
        elif kind is CameraOptions and keys == ["log"]:
            table.pop("camera", None)
            if self.plain["restart"] != "never":
                table.setdefault("mode", "realtime")
        known = kind.__struct_fields__
        if keys[0] not in known:
            known = (*known, *(LiveCamera.__struct_fields__ if kind is CameraOptions else ()), "restart", "enabled")
            raise ConfigError(
                f"{self._path}: node '{node['name']}' has no option '{keys[0]}'{_nearest(keys[0], known)}"
            )
        *tables, last = keys
        struct: type[msgspec.Struct] | None = kind
        for key in tables:
            struct = _struct_of(key, table)
            table = table.setdefault(key, {})
            if not isinstance(table, dict):
                raise ConfigError(
                    f"{self._path}: {node['name']}.{'.'.join(tables)} names the file {table!r}; set '{last}' there"
                )
        table[last] = _typed(text, Any if struct is None else _field_type(struct, last))


def _struct_of(key: str, camera: Mapping[str, Any]) -> type[msgspec.Struct] | None:
    """What the table `config` or `poses` of a camera is checked against; None where that is not known."""
    if key == "config" and camera.get("kind") in CAMERA_KINDS:
        return importlib.import_module(f"semantic_mapper.drivers.{camera['kind']}.config").Config
    poses = camera.get("poses")
    if key == "poses" and isinstance(poses, dict):
        return importlib.import_module("semantic_mapper.drivers.poses.config").KINDS.get(poses.get("kind"))
    return None


def _field_type(struct: type[msgspec.Struct], name: str) -> Any:
    types = {item.encode_name: item.type for item in msgspec.structs.fields(struct)}
    return types.get(name, Any)


def _typed(text: str, kind: Any) -> Any:
    """A value as its setting wants it; what is to be a text stays one, whatever it looks like: ids may be numbers."""
    try:
        parsed = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # a bare word, such as a path, or a number of thousands of digits
        return text
    if kind is Any or isinstance(parsed, str):
        return parsed
    for value in (parsed, text) if isinstance(parsed, list | dict) else (text, parsed):
        try:
            msgspec.convert(value, kind)
        except msgspec.ValidationError:
            continue
        return value
    return parsed


def _parse_setting(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"--set {text}: write NODE.OPTION=VALUE")
    return name, value


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


def _complete_cameras(nodes: Sequence[NodeEntry]) -> None:
    """Poses of cameras that know them, and a history for the map where poses close loops."""
    for node in nodes:
        live = node.options.get("camera")
        if node.kind != "camera" or not isinstance(live, dict):
            continue
        if "poses" not in live and live.get("kind") in DEFAULT_POSES:
            live["poses"] = {"kind": DEFAULT_POSES[live["kind"]]}
        poses, config = live.get("poses"), live.setdefault("config", {})
        if not isinstance(poses, dict):
            continue
        if poses.get("kind") == "device" and live.get("kind") == "oak" and isinstance(config, dict):
            config.setdefault("odometry", True)
        if poses.get("kind") == "rgbd" and "corrections" not in node.options:
            mappers = [n.options for n in nodes if n.kind == "mapper" and n.options.get("input", "camera") == node.name]
            for mapper in mappers:
                mapper.setdefault("history_frames", HISTORY_FRAMES)
                node.options["corrections"] = mapper.get("query", "query")


def _complete_viewers(nodes: Sequence[NodeEntry]) -> None:
    """Where the mapper of a viewer answers, and its keys."""
    mappers = {node.name: node.options for node in nodes if node.kind == "mapper"}
    for node in nodes:
        if node.kind == "foxglove":
            mapper = mappers.get(node.options.get("mapper", "mapper"), {})
            for name in ("query", "keys"):
                if name in mapper:
                    node.options.setdefault(name, mapper[name])


def _convert_options(node: NodeEntry, keys: str, path: Path) -> NodeOptions:
    where, kind = f"{path}: node '{node.name}'", OPTIONS[node.kind]
    plain = {**({"keys": keys} if keys and "keys" in kind.__struct_fields__ else {}), **node.options}
    for item in msgspec.structs.fields(kind):
        if plain.get(item.encode_name) == "" and (item.required or item.default is None):
            name = f"{node.name}.{item.encode_name}"
            raise ConfigError(f"{where}: needs '{item.encode_name}'; give it with --set {name}=... or in the file")
    _check_camera_kinds(plain.get("camera"), node.name, where)
    return convert_config(plain, kind, where)


def _check_camera_kinds(camera: Any, node: str, where: str) -> None:
    """Say at once, before a mapper has started, what the camera's own process would refuse much later.

    Raises:
        ConfigError: no such kind of camera or of poses, or no poses at all.
    """
    if not isinstance(camera, dict):
        return
    kind, poses = camera.get("kind"), camera.get("poses")
    if not kind:
        raise ConfigError(
            f"{where}: which kind of camera? Give --set {node}.kind=KIND; there are {', '.join(CAMERA_KINDS)}"
        )
    if isinstance(kind, str) and kind not in CAMERA_KINDS:
        raise ConfigError(f"{where}: `camera.kind`: no kind of camera is called '{kind}'{_nearest(kind, CAMERA_KINDS)}")
    if poses is None or poses in ({}, ""):
        raise ConfigError(
            f"{where}: `camera.poses` is {'missing' if poses is None else 'empty'}: a camera alone does not know "
            f"where it is. Give --set {node}.poses.kind=KIND, or in the file [node.options.camera.poses], with kind "
            '"topic" (odometry from a socket), "board" (a printed board), "rgbd" (odometry from depth), "visual" (from '
            'its pictures alone), "device" (it tracks itself, OAK) or "fixed" (it never moves); for example '
            'poses = { kind = "topic", endpoint = "tcp://127.0.0.1:5560" }'
        )
    if isinstance(poses, dict) and poses.get("kind") not in POSE_KINDS:
        if "kind" not in poses:
            raise ConfigError(f"{where}: `camera.poses` has no kind; there are {', '.join(POSE_KINDS)}")
        named = str(poses["kind"])
        raise ConfigError(f"{where}: `camera.poses.kind`: '{named}' is no source of poses{_nearest(named, POSE_KINDS)}")
    if isinstance(poses, dict):
        try:
            check_tracking(str(kind), poses["kind"])
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from error


def _check_restarts(nodes: Iterable[NodeEntry], options: Mapping[str, NodeOptions], path: Path) -> None:
    """Restarts are for what is live: frames that wait for their readers have a result, which a restart would spoil.

    Raises:
        ConfigError: a node is to be restarted while a camera waits for others; or there is no camera.
    """
    cameras = {name: own for name, own in options.items() if isinstance(own, CameraOptions)}
    if not cameras:
        raise ConfigError(f"{path}: no node of kind 'camera': nothing would ever happen")
    restarted = [n.name for n in nodes if n.restart != "never"]
    waiting = [name for name, own in cameras.items() if not own.live]
    if restarted and waiting:
        raise ConfigError(
            f"{path}: node '{restarted[0]}' is to be restarted, but camera '{waiting[0]}' waits for those who read its "
            f"frames, and what they have lost would be missing in the result; set {waiting[0]}.mode=realtime, or "
            "restart=never"
        )


def _check_cameras(options: Mapping[str, NodeOptions], path: Path) -> None:
    """Frames that go to one place are distinguished by the names of their cameras.

    Raises:
        ConfigError: two cameras of one name, frames of what is no camera, or the map of what is no mapper.
    """
    for name, own in options.items():
        if not isinstance(own, MapperOptions | RecorderOptions | FoxgloveOptions):
            continue
        cameras: dict[str, CameraOptions] = {}
        for source in own.cameras:
            camera = options[source]
            if not isinstance(camera, CameraOptions):
                raise ConfigError(f"{path}: node '{name}' takes the frames of '{source}', which is no camera")
            cameras[source] = camera
        check_camera_ids(name, cameras, str(path))
        if isinstance(own, FoxgloveOptions) and not isinstance(options[own.mapper], MapperOptions):
            raise ConfigError(f"{path}: node '{name}' shows the map of '{own.mapper}', which is no mapper")


def _nearest(name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(names[:MAX_NODES]) or 'none'}"
