"""Launch files: which nodes run, with which options, and who listens to whom."""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import structlog

from semantic_mapper.config import Config, convert_config, load_config
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.nodes.camera.ids import check_camera_ids
from semantic_mapper.nodes.options import (
    CAMERA_KINDS,
    OPTIONS,
    POSE_KINDS,
    BridgeOptions,
    CameraOptions,
    Count,
    FinetunerOptions,
    MapperOptions,
    NodeOptions,
    Positive,
    RecorderOptions,
    ZenohOptions,
    check_tracking,
)

Value = str | int | float | bool
STATUS_SOCKET = "launch"  # where the launcher publishes how all nodes are
MAX_NODES = 64  # each is a process
MAX_SHOWN = 60  # letters of an argument in a message
MAX_TEXT = 4096  # letters of a text, once values of [set] are filled in
_log = structlog.get_logger(__name__)

_PLACE = re.compile(r"\{(\w+)\}")


class NodeEntry(Config, frozen=True):
    """One process; ``process_table.py`` says how its kind is started and stopped."""

    name: str  # unique; also the name of its endpoint
    kind: Literal["camera", "mapper", "recorder", "finetuner", "foxglove", "zenoh"]  # a row of the process table
    options: dict[str, Any] = msgspec.field(
        default_factory=dict
    )  # see nodes/options.py; "{NAME}" stands for a value of [set]
    # "on-failure": a node that is killed, terminated (SIGTERM of anybody but its launcher), hangs or fails restarts,
    # and the others go on meanwhile; except where it fails by itself before it was ever ready, which the next start
    # would not mend. "never": the launch ends then. A node that is done, such as a log played to its end, stays away.
    restart: Literal["never", "on-failure"] = "never"
    backoff_s: Positive = 0.1  # pause before the first restart; twice as long with each further one in the window
    backoff_max_s: Positive = 10.0  # but no longer than this
    # This many within the window; the next failure ends the launch. With the defaults a node that was ever ready is
    # restarted for as long as the launch runs: back-off leaves no room for that many.
    max_restarts: Count = 20
    window_s: Positive = 60.0
    standby: bool = False  # does nothing any more, and is accepted with a warning: restarts are quick without it


class Limits(Config, frozen=True):
    """What a launch file says of the launch as a whole."""

    # A node that gives no sign of life for so long, and neither has had nor wants processor time meanwhile, is killed.
    # One that starts or ends, or is busy, or waits for a processor or a disk, may be silent for half a minute.
    heartbeat_s: Annotated[float, msgspec.Meta(ge=0.5)] = 30.0
    # So long a turn of its main loop may take (the first frames compile), and its start until it is ready; while it
    # waits for a processor that others use, that does not count.
    stall_s: Positive = 300.0
    start_s: Positive = 300.0
    # How long a node may make no progress when it is to end: camera, recorder and bridges; mapper (it writes its map)
    # and finetuner. One that gets on, be it slowly, may take as long as it needs.
    stop_s: Positive = 15.0
    finish_s: Positive = 300.0
    # A fixed endpoint at which the status of all nodes can be subscribed to (`semantic-mapper view --status`), next to
    # that in the folder of sockets: ipc://PATH, tcp://127.0.0.1:PORT, with keys also tcp://0.0.0.0:PORT; empty = none.
    publish: Annotated[str, msgspec.Meta(pattern=r"^([a-z]+://.+|\{\w+\}|)\Z")] = ""
    keys: str = ""  # folder of keys (`semantic-mapper keys`) for it; empty = none


class LaunchFile(Limits, frozen=True, kw_only=True):
    """A launch file as it stands on disk."""

    node: Annotated[tuple[NodeEntry, ...], msgspec.Meta(max_length=MAX_NODES)]
    # Values that `--set NAME=VALUE` replaces; an empty one has to be given. "{now}" in one of them stands for the time
    # of the start, such as 20261123T024700Z, with a number where that is there already.
    set: dict[str, Value] = msgspec.field(default_factory=dict)


class Launch(Limits, frozen=True, kw_only=True):
    """A launch file with every option checked, ready to start.

    ``options`` are by node name, in the order of the file.
    """

    name: str  # of the file
    nodes: tuple[NodeEntry, ...]
    options: dict[str, NodeOptions]

    def inputs(self, name: str) -> tuple[str, ...]:
        """Names of the nodes that a node subscribes to."""
        return self.options[name].inputs()

    def sockets(self) -> tuple[str, ...]:
        """Names of all endpoints: of the nodes, where mappers answer questions and labels come, the launcher's own."""
        others = [o.query for o in self.options.values() if isinstance(o, MapperOptions)]
        others += [o.labels for o in self.options.values() if isinstance(o, FinetunerOptions)]
        return (STATUS_SOCKET, *self.options, *(name for name in others if name and "://" not in name))

    def listeners(self, name: str) -> int:
        """How many nodes subscribe to the frames of a node."""
        kinds = MapperOptions | RecorderOptions | BridgeOptions
        return sum(name in o.inputs() for o in self.options.values() if isinstance(o, kinds))


def load_launch(path: Path, settings: Sequence[str] = (), out: Path | None = None) -> Launch:
    """Read and check a launch file.

    Args:
        path: Of the file.
        settings: "NAME=VALUE", each for a value of the file's [set] table.
        out: The same as "out=DIR".

    Raises:
        ConfigError: unknown key, name or node (with the nearest valid one), a missing value, or one of a wrong type.
    """
    file = load_config(path, LaunchFile)
    values: dict[str, Value] = {"now": "", **file.set}
    changes = [_parse_setting(s, file.set) for s in settings] + ([("out", str(out))] if out is not None else [])
    for name, value in changes:
        if name not in values:
            raise ConfigError(f"{path}: nothing is called '{name}' in its [set] table{_nearest(name, values)}")
        values[name] = value
    values["now"] = values["now"] or _name_start(values)
    values = {k: v.replace("{now}", str(values["now"])) if isinstance(v, str) else v for k, v in values.items()}
    if old := [n.name for n in file.node if n.standby]:
        _log.warning("setting_ignored", setting="standby", nodes=", ".join(old), reason="restarts are quick without it")
    names = [n.name for n in file.node]
    for name in names:
        if names.count(name) > 1 or not re.fullmatch(r"[A-Za-z0-9_.-]{1,48}", name):
            raise ConfigError(f"{path}: node names must be unique words of letters, digits and _ . -, got '{name}'")
    options = {n.name: _convert_options(n, values, path) for n in file.node}
    for name, own in options.items():
        for source in own.inputs():
            if source not in names:
                raise ConfigError(
                    f"{path}: node '{name}' listens to '{source}', which is no node{_nearest(source, names)}"
                )
    if not any(isinstance(o, CameraOptions) for o in options.values()):
        raise ConfigError(f"{path}: no node of kind 'camera': nothing would ever happen")
    _check_restarts(file, options, path)
    _check_cameras(options, path)
    _check_bridges(options, path)
    limits = {name: getattr(file, name) for name in Limits.__struct_fields__}
    limits |= {name: str(_fill_in(limits[name], values, f"{path}: {name}")) for name in ("publish", "keys")}
    launch = Launch(name=path.name, nodes=file.node, options=options, **limits)
    sockets = launch.sockets()
    twice = sorted({name for name in sockets if sockets.count(name) > 1})
    if twice:
        raise ConfigError(
            f"{path}: {', '.join(twice)}: names two endpoints; give each mapper a `query` of its own that is no node "
            f"('{STATUS_SOCKET}' is the launcher's own)"
        )
    return launch


def _check_restarts(file: LaunchFile, options: Mapping[str, NodeOptions], path: Path) -> None:
    """Restarts are for what is live: frames that wait for their readers have a result, which a restart would spoil.

    Raises:
        ConfigError: a node is to be restarted while a camera waits for others.
    """
    restarted = [n.name for n in file.node if n.restart != "never"]
    waiting = [name for name, own in options.items() if isinstance(own, CameraOptions) and not own.live]
    if restarted and waiting:
        raise ConfigError(
            f"{path}: node '{restarted[0]}' is to be restarted, but camera '{waiting[0]}' waits for those who read its "
            'frames, and what they have lost would be missing in the result; set mode = "realtime" there, or '
            'restart = "never" here'
        )


def _check_cameras(options: Mapping[str, NodeOptions], path: Path) -> None:
    """Frames that go to one place are distinguished by the names of their cameras.

    Raises:
        ConfigError: two cameras of one name.
    """
    for name, own in options.items():
        if not isinstance(own, MapperOptions | RecorderOptions | BridgeOptions):
            continue
        for source in own.cameras:
            if not isinstance(options[source], CameraOptions):
                raise ConfigError(f"{path}: node '{name}' takes the frames of '{source}', which is no camera")
        cameras = {source: options[source] for source in own.cameras}
        check_camera_ids(name, {s: c for s, c in cameras.items() if isinstance(c, CameraOptions)}, str(path))


def _check_bridges(options: Mapping[str, NodeOptions], path: Path) -> None:
    """A bridge to other tools asks a mapper of its launch about the map.

    Raises:
        ConfigError: it would ask where none answers, or an invalid address.
        TransportError: of Zenoh, see ``zenoh_settings``.
    """
    for name, own in options.items():
        if isinstance(own, ZenohOptions):
            _check_zenoh(own, f"{path}: node '{name}'")
        if isinstance(own, BridgeOptions):
            mapper = options[own.mapper]
            if not isinstance(mapper, MapperOptions):
                raise ConfigError(f"{path}: node '{name}' shows the map of '{own.mapper}', which is no mapper")
            if mapper.query != own.query:
                raise ConfigError(
                    f"{path}: node '{name}' asks about the map at '{own.query}', but mapper '{own.mapper}' answers at "
                    f"'{mapper.query}'; give both the same `query`"
                )
            if mapper.keys != own.keys:
                raise ConfigError(
                    f"{path}: node '{name}' has the keys '{own.keys}', but mapper '{own.mapper}' '{mapper.keys}'; give "
                    "both the same folder as `keys`"
                )


def _check_zenoh(options: ZenohOptions, where: str) -> None:
    from semantic_mapper.nodes.zenoh.addresses import zenoh_settings  # loads ZeroMQ, which few commands need

    try:
        zenoh_settings(options)
    except SemanticMapperError as error:
        raise type(error)(f"{where}: {error}") from error


def _convert_options(node: NodeEntry, values: Mapping[str, Value], path: Path) -> NodeOptions:
    where = f"{path}: node '{node.name}'"
    fields = msgspec.structs.fields(OPTIONS[node.kind])
    required = {
        f.encode_name for f in fields if f.required or f.default is None
    }  # None: no text, rather than an empty one
    for key, value in node.options.items():
        whole = _PLACE.fullmatch(value) if isinstance(value, str) else None
        if key in required and whole is not None and values.get(whole[1]) == "":
            raise ConfigError(f"{where}: needs '{key}'; give it with --set {whole[1]}=... or in the file's [set] table")
    plain = {key: _fill_in(value, values, f"{where}: {key}") for key, value in node.options.items()}
    _check_camera_kinds(plain.get("camera"), where)
    return convert_config(plain, OPTIONS[node.kind], where)


def _check_camera_kinds(camera: Any, where: str) -> None:
    """Say at once, before a mapper has started, what the camera's own process would refuse much later.

    Raises:
        ConfigError: no such kind of camera or of poses, or no poses at all.
    """
    if not isinstance(camera, dict):
        return
    kind, poses = camera.get("kind"), camera.get("poses")
    if isinstance(kind, str) and kind not in CAMERA_KINDS:
        raise ConfigError(f"{where}: `camera.kind`: no kind of camera is called '{kind}'{_nearest(kind, CAMERA_KINDS)}")
    if poses is None or poses in ({}, ""):
        raise ConfigError(
            f"{where}: `camera.poses` is {'missing' if poses is None else 'empty'}: a camera alone does not know "
            'where it is. Write [node.options.camera.poses] with kind = "topic" (odometry from a socket), "board" (a '
            'printed board), "rgbd" (odometry from depth), "visual" (from its pictures alone), "device" (it tracks '
            'itself, OAK) or "fixed" (it never moves); for example '
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


def _fill_in(value: Any, values: Mapping[str, Value], where: str) -> Any:
    """Replace "{NAME}" in texts; a text that is nothing else takes the value's own type."""
    if isinstance(value, list):
        return [_fill_in(v, values, where) for v in value]
    if isinstance(value, dict):
        return {k: _fill_in(v, values, f"{where}.{k}") for k, v in value.items()}
    if not isinstance(value, str):
        return value
    for name in _PLACE.findall(value):
        if name not in values:
            raise ConfigError(f"{where}: nothing is called '{name}' in the [set] table{_nearest(name, values)}")
    whole = _PLACE.fullmatch(value)
    if whole is not None:
        return values[whole[1]]
    places = [str(values[name]) for name in _PLACE.findall(value)]
    if len(value) + sum(map(len, places)) > MAX_TEXT:
        raise ConfigError(f"{where}: is longer than {MAX_TEXT} letters with the values of the [set] table in it")
    return _PLACE.sub(lambda found: str(values[found[1]]), value)


def _name_start(values: Mapping[str, Value]) -> str:
    """The time, and a number where something is called so already: clocks are set back, or begin again each day."""
    time = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    places = [value for value in values.values() if isinstance(value, str) and "{now}" in value]
    names = (time, *(f"{time}-{n}" for n in range(1, 1000)))
    free = (name for name in names if not any(os.path.exists(p.replace("{now}", name)) for p in places))
    return next(free, time)


def _parse_setting(text: str, own: Mapping[str, Value]) -> tuple[str, Value]:
    """NAME=VALUE. What is a text in the file stays one, whatever it looks like: ids of devices may be numbers."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"--set {text[:MAX_SHOWN]}: write NAME=VALUE")
    if len(value) > MAX_TEXT:
        raise ConfigError(f"--set {name[:MAX_SHOWN]}: the value is longer than {MAX_TEXT} letters")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):  # a bare word, such as a path, or a number of thousands of digits
        return name, value
    kinds = str if isinstance(own.get(name, ""), str) else str | int | float | bool
    return name, parsed if isinstance(parsed, kinds) else value


def _nearest(name: str, names: Sequence[str] | Mapping[str, Value]) -> str:
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(list(names)[:MAX_NODES]) or 'none'}"
