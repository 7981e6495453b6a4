"""Every name that a TOML file of users may hold is still taken, and stands for what it stood for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.contract import entry_points as api
from tests.contract.golden import plain, read

INFINITE = "infinite"  # stands for ``inf``, which JSON does not know
# Values of settings that are nothing by default, which TOML cannot say.
_IDENTITY = [[float(i == j) for j in range(4)] for i in range(4)]
EXAMPLES: dict[str, Any] = {
    "launch.camera.camera": {"kind": "v4l2", "poses": {"kind": "fixed"}},
    "launch.camera.camera.T_rig_camera": _IDENTITY,
    "poses.fixed.T_world_rig": _IDENTITY,
    "calibration.T_rig_camera": _IDENTITY,
}


def observe() -> dict[str, Any]:
    """Defaults of all settings, by table and dotted name; nodes of shipped launch files."""
    files = {path.name: api.launch_nodes(path) for path in sorted(api.LAUNCH.glob("*.toml"))}
    return {"defaults": {name: defaults(name) for name in api.SETTINGS}, "launch": files}


def defaults(name: str) -> dict[str, Any]:
    """Dotted name and default of each setting of a table."""
    struct, required = api.SETTINGS[name]
    values = plain(api.parse_settings(name, needed(name, required)))
    found: dict[str, Any] = {}
    for key, value in _leaves(values, struct):
        found[key] = INFINITE if value == float("inf") else value
    return found


def needed(name: str, required: Mapping[str, Any]) -> dict[str, Any]:
    """What a table must have."""
    return {**required, **({"endpoint": "tcp://127.0.0.1:5560"} if name == "poses.topic" else {})}


def _leaves(values: Any, struct: Any, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for item in msgspec.structs.fields(struct):
        value, key = values[item.name], f"{prefix}{item.encode_name}"
        inner = item.type
        if isinstance(inner, type) and issubclass(inner, msgspec.Struct) and isinstance(value, Mapping):
            found += _leaves(value, inner, f"{key}.")
        else:
            found.append((key, value))
    return found


_FILE: dict[str, Any] = read("settings")
_GOLDEN: dict[str, dict[str, Any]] = _FILE["defaults"]


def nested(key: str, value: Any) -> dict[str, Any]:
    """``a.b`` and a value -> a table in a table."""
    for word in reversed(key.split(".")):
        value = {word: value}
    return value


def value_at(settings: Any, key: str, renamed: Any) -> Any:
    """The setting of a dotted name; ``renamed`` where it is called otherwise now."""
    for word in key.split("."):
        names = {item.encode_name: item.name for item in msgspec.structs.fields(settings)}
        if word not in names:
            return renamed
        settings = getattr(settings, names[word])
    return settings


def merged(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    """Both tables; of what both have, the second."""
    return {**a, **b}


def test_all_tables_are_held() -> None:
    assert set(_GOLDEN) == set(api.SETTINGS)


@pytest.mark.parametrize("name", _GOLDEN)
def test_every_name_is_taken_with_the_value_it_had(name: str) -> None:
    refused: list[str] = []
    bare = api.parse_settings(name, needed(name, api.SETTINGS[name][1]))
    for key, value in _GOLDEN[name].items():
        given = float("inf") if value == INFINITE else EXAMPLES.get(f"{name}.{key}", value)
        if (
            given is None
        ):  # no TOML file can say that; but the name must be known, so that a wrong type is what is wrong
            refused += _refuses_name(name, key)
            continue
        table = nested(key, given)
        required = needed(name, api.SETTINGS[name][1])
        if f"{name}.{key}" == "launch.camera.camera":  # in the place of a log
            required = {}
        try:
            parsed = api.parse_settings(name, merged(required, table))
        except api.SemanticMapperError as error:
            refused.append(str(error))
            continue
        if f"{name}.{key}" in EXAMPLES:
            continue
        for which, settings in (("given", parsed), ("default", bare)):
            found = value_at(settings, key, given)
            if plain(found) != plain(given):
                refused.append(f"{name}: {key} = {given!r} comes out as {found!r} where it is {which}")
    assert refused == []


def _refuses_name(name: str, key: str) -> list[str]:
    try:
        api.parse_settings(name, merged(needed(name, api.SETTINGS[name][1]), nested(key, {"no": ["such"]})))
    except api.SemanticMapperError as error:
        return [str(error)] if f"unknown key `{key.rpartition('.')[2]}`" in str(error) else []
    return []


def _toml_files() -> list[Path]:
    return [*sorted(api.LAUNCH.rglob("*.toml")), *sorted(api.CLASS_FILES.glob("*.toml"))]


@pytest.mark.parametrize("path", _toml_files(), ids=lambda p: p.name)
def test_shipped_files_are_read(path: Path, tmp_path: Path) -> None:
    if path.is_relative_to(api.LAUNCH):
        given = {"camera": ["camera.kind=oak"], "replay": ["camera.log=a.mcap"]}.get(path.stem, [])
        assert api.load_launch(path, given, tmp_path).nodes
    else:
        assert api.load_config(path, api.SETTINGS["rename"][0])


@pytest.mark.parametrize("name", _FILE["launch"])
def test_a_shipped_launch_file_has_the_same_nodes(name: str) -> None:
    assert _FILE["launch"][name] == api.launch_nodes(api.LAUNCH / name)
