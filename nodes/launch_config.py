"""Launch files: which nodes run, with which options, and who listens to whom."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from nodes.options import OPTIONS, CameraOptions, MapperOptions, NodeOptions, RecorderOptions
from semantic_mapper.config import Config, convert_config, load_config
from semantic_mapper.errors import ConfigError

Value = str | int | float | bool
_PLACE = re.compile(r"\{(\w+)\}")


class NodeEntry(Config, frozen=True):
    """One process."""

    name: str  # unique; also the name of its endpoint
    kind: Literal["camera", "mapper", "recorder"]  # runs `python -I -m nodes.KIND`
    options: dict[str, Any] = msgspec.field(
        default_factory=dict
    )  # see nodes/options.py; "{NAME}" stands for a value of [set]


class LaunchFile(Config, frozen=True):
    """A launch file as it stands on disk."""

    node: tuple[NodeEntry, ...]
    set: dict[str, Value] = msgspec.field(
        default_factory=dict
    )  # values that `--set NAME=VALUE` replaces; an empty one has to be given
    heartbeat_s: float = 30.0  # a node that gives no sign of life for so long is killed
    stop_s: float = 15.0  # how long camera and recorder may take to end when asked to
    finish_s: float = 300.0  # how long a mapper may take to write its map


class Launch(Config, frozen=True):
    """A launch file with every option checked, ready to start.

    ``options`` are by node name, in the order of the file.
    """

    nodes: tuple[NodeEntry, ...]
    options: dict[str, NodeOptions]
    heartbeat_s: float
    stop_s: float
    finish_s: float

    def inputs(self, name: str) -> tuple[str, ...]:
        """Names of the nodes that a node subscribes to."""
        return self.options[name].inputs()

    def sockets(self) -> tuple[str, ...]:
        """Names of all endpoints: those of the nodes, and those where mappers answer questions."""
        mappers = [o for o in self.options.values() if isinstance(o, MapperOptions)]
        return (*self.options, *(o.query for o in mappers if o.query and "://" not in o.query))

    def listeners(self, name: str) -> int:
        """How many nodes subscribe to the frames of a node."""
        kinds = MapperOptions | RecorderOptions
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
    values = dict(file.set)
    changes = [_parse_setting(s) for s in settings] + ([("out", str(out))] if out is not None else [])
    for name, value in changes:
        if name not in values:
            raise ConfigError(f"{path}: nothing is called '{name}' in its [set] table{_nearest(name, values)}")
        values[name] = value
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
    launch = Launch(
        nodes=file.node, options=options, heartbeat_s=file.heartbeat_s, stop_s=file.stop_s, finish_s=file.finish_s
    )
    sockets = launch.sockets()
    twice = sorted({name for name in sockets if sockets.count(name) > 1})
    if twice:
        raise ConfigError(
            f"{path}: {', '.join(twice)}: names two endpoints; give each mapper a `query` of its own that is no node"
        )
    return launch


def _convert_options(node: NodeEntry, values: Mapping[str, Value], path: Path) -> NodeOptions:
    where = f"{path}: node '{node.name}'"
    required = {f.encode_name for f in msgspec.structs.fields(OPTIONS[node.kind]) if f.required}
    for key, value in node.options.items():
        whole = _PLACE.fullmatch(value) if isinstance(value, str) else None
        if key in required and whole is not None and values.get(whole[1]) == "":
            raise ConfigError(f"{where}: needs '{key}'; give it with --set {whole[1]}=... or in the file's [set] table")
    plain = {key: _fill_in(value, values, f"{where}: {key}") for key, value in node.options.items()}
    return convert_config(plain, OPTIONS[node.kind], where)


def _fill_in(value: Any, values: Mapping[str, Value], where: str) -> Any:
    """Replace "{NAME}" in texts; a text that is nothing else takes the value's own type."""
    if isinstance(value, list):
        return [_fill_in(v, values, where) for v in value]
    if not isinstance(value, str):
        return value
    for name in _PLACE.findall(value):
        if name not in values:
            raise ConfigError(f"{where}: nothing is called '{name}' in the [set] table{_nearest(name, values)}")
    whole = _PLACE.fullmatch(value)
    if whole is not None:
        return values[whole[1]]
    return _PLACE.sub(lambda found: str(values[found[1]]), value)


def _parse_setting(text: str) -> tuple[str, Value]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise ConfigError(f"--set {text}: write NAME=VALUE")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:  # a bare word, such as a path
        return name, value
    return name, parsed if isinstance(parsed, str | int | float | bool) else value


def _nearest(name: str, names: Sequence[str] | Mapping[str, Value]) -> str:
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; there are {', '.join(names) or 'none'}"
