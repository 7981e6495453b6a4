"""Saved maps, logs and transforms as the command line names them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import check_pose, yaw_transform
from semantic_mapper.types import Float64

MAP_NAME = "map.npz"
MAP_SUFFIX = ".npz"
LOG_SUFFIX = ".mcap"
STORE_MARK = "fleet.json"


def map_path(path: Path) -> Path:
    """The file of a map that is named itself, or by the folder it is in.

    Raises:
        ConfigError: no map is there, or it is a log.
    """
    if path.is_dir() and not (path / MAP_NAME).is_file():
        raise ConfigError(f"{path}: no {MAP_NAME} in this folder; {_instead_of_map(path)}")
    if not path.exists():
        raise ConfigError(f"{path}: no such map file or folder")
    if is_log(path):
        raise ConfigError(f"{path}: is a log; `semantic-mapper replay {path} --out FOLDER` makes a map of it")
    return path / MAP_NAME if path.is_dir() else path


def _instead_of_map(folder: Path) -> str:
    """What to do about a folder without a map, from what is in it."""
    maps = sorted(file.name for file in folder.glob(f"*{MAP_SUFFIX}"))
    if (folder / STORE_MARK).is_file():
        return "a fleet's store: `fleet merge` fuses its maps; or name one of them in results/"
    if maps:
        return f"name the map itself, such as {folder / maps[0]}"
    results = sorted(file.parent.name for file in folder.glob(f"*/{MAP_NAME}"))
    if results:
        return f"there is one in {folder / results[0]}"
    if is_log(folder):
        return f"its logs hold frames: `semantic-mapper replay {folder} --out FOLDER` makes a map of them"
    return "give a saved map or a folder that `replay` has written"


def refuse_overwriting(out: Path, *sources: Path) -> None:
    """Refuse a result under the name of what it is made from.

    Raises:
        ConfigError: naming the file.
    """
    if out.resolve() in {source.resolve() for source in sources}:
        raise ConfigError(f"{out}: is the map itself; choose another name for the result")


def parse_transform(text: str) -> Float64:
    """``"x y z yaw_deg"``, or the name of a text file that holds a rigid (4, 4) row by row.

    Raises:
        ConfigError: neither of these.
        PoseError: the file holds something else than a rigid transform.
    """
    words = text.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return _read_transform(Path(text))
    if len(numbers) != 4 or not np.isfinite(numbers).all():
        raise ConfigError(f"--transform '{text}': expected four numbers, x y z in metres and yaw in degrees")
    return yaw_transform(np.array(numbers[:3]), numbers[3])


def _read_transform(path: Path) -> Float64:
    try:
        T = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except FileNotFoundError as error:
        raise ConfigError(f'--transform {path}: neither "x y z yaw_deg" nor a file') from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"--transform {path}: cannot be read as numbers: {error}") from error
    if T.shape != (4, 4):
        raise ConfigError(f"--transform {path}: expected 4 rows of 4 numbers, got {T.shape[0]} of {T.shape[1]}")
    check_pose(T, str(path))
    return T


def is_map(source: Path) -> bool:
    """Whether a saved map is meant: a map file, or a folder with one."""
    return source.suffix == MAP_SUFFIX or (source / MAP_NAME).is_file()


def is_log(source: Path) -> bool:
    """Whether a log is meant rather than a map: a log file, or a folder with logs and no map."""
    if source.is_dir():
        return not (source / MAP_NAME).exists() and any(source.glob(f"*{LOG_SUFFIX}"))
    return source.suffix == LOG_SUFFIX
