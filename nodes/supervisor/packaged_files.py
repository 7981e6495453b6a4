"""Launch files that come with the package: ``launch/`` of the top level."""

from __future__ import annotations

from pathlib import Path

import semantic_mapper
from semantic_mapper.errors import ConfigError

_PACKAGE = Path(semantic_mapper.__file__).parent
LAUNCH_FOLDER = _PACKAGE / "launch_files"
UNIT = "semantic-mapper.service"


def launch_files() -> dict[str, Path]:
    """Launch files of the package by name ("replay"), and the systemd unit by its file name."""
    files = {path.stem: path for path in sorted(LAUNCH_FOLDER.glob("*.toml"))}
    return {**files, UNIT: LAUNCH_FOLDER / "systemd" / UNIT}


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
    if path.parent == Path() and name in files and name != UNIT:
        return files[name]
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; name a launch file in it")
    names = ", ".join(name for name in files if name != UNIT)
    raise ConfigError(f"{path}: no such file; launch files that come with the package: {names}")
