"""Folders and files of results: checked before minutes are spent on them, held by one run, found by their names."""

import fcntl
import os
import shlex
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from semantic_mapper.config import nearest_path
from semantic_mapper.errors import ConfigError
from semantic_mapper.files import remove_stale
from semantic_mapper.log_events import get_logger

MAP_NAME = "map.npz"
MAP_SUFFIX = ".npz"
LOG_SUFFIX = ".mcap"
STORE_MARK = "fleet.json"

_log = get_logger(__name__)


def prepare_file(path: Path) -> None:
    """Make sure that a file can be written, before minutes are spent on what is to be in it; else ``ConfigError``."""
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file")
    prepare_folder(path.parent)


def prepare_folder(out: Path) -> None:
    """Make the folder for results, before minutes are spent on them; ``ConfigError`` where that is not possible."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ConfigError(f"{out}: cannot hold the results ({error.strerror}); choose another folder") from error


def free_name(path: Path) -> Path:
    """The path, or the first of "NAME-1", "NAME-2", ... where nothing is yet."""
    names = (path, *(path.with_stem(f"{path.stem}-{n}") for n in range(1, 1000)))
    return next(p for p in names if not p.exists())


@contextmanager
def folder_for_results(out: Path) -> Iterator[None]:
    """As ``prepare_folder``; removes the folder again where an error leaves it empty."""
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        prepare_folder(out)
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):  # something is in it
                folder.rmdir()
        raise


@contextmanager
def hold_folder(out: Path) -> Iterator[None]:
    """As ``folder_for_results``, and keeps other runs out of the folder for as long as this one lasts.

    Raises ConfigError: it cannot be made or written to, or another run writes its results there.
    """
    with folder_for_results(out):
        folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(folder)
            raise ConfigError(
                f"{out}: another run writes its results there; choose another folder (--out), or wait until it ends"
            ) from None
        except OSError as error:  # file systems without locks
            _log.warning("folder_not_held", folder=str(out), reason=error.strerror)
        try:
            for left in remove_stale(out):
                _log.info("unfinished_file_removed", path=str(left))
            yield
        finally:
            os.close(folder)


def map_path(path: Path) -> Path:
    """The file of a map that is named itself, or by its folder. Raises ConfigError: no map is there, or it is a log;
    with what to do, from what is there."""
    if not path.exists():
        raise ConfigError(f"{path}: no such map file or folder{nearest_path(path)}")
    if path.is_dir() and (path / MAP_NAME).is_file():
        return path / MAP_NAME
    if is_log(path):
        raise ConfigError(f"{path}: is a log; `semantic-mapper map {shlex.quote(str(path))}` makes a map of it")
    if not path.is_dir():
        return path
    maps = [*sorted(path.glob(f"*{MAP_SUFFIX}")), *sorted(path.glob(f"*/{MAP_NAME}"))]
    hint = f"name the map itself, such as {maps[0]}" if maps else "give a saved map or a folder of `map`"
    if (path / STORE_MARK).is_file():
        hint = "a fleet's store: `merge` makes one map of its maps; or name one of them in files/"
    raise ConfigError(f"{path}: no {MAP_NAME} in this folder; {hint}")


def refuse_overwriting(out: Path, *sources: Path) -> None:
    """Refuse a result under the name of what it is made from, by a ``ConfigError``."""
    if out.resolve() in {source.resolve() for source in sources}:
        raise ConfigError(f"{out}: the result is made from it; choose another name")


def is_map(source: Path) -> bool:
    """Whether a saved map is meant: a map file, or a folder with one."""
    return source.suffix == MAP_SUFFIX or (source / MAP_NAME).is_file()


def is_log(source: Path) -> bool:
    """Whether a log is meant rather than a map: a log file, or a folder with logs and no map."""
    if source.is_dir():
        return not (source / MAP_NAME).exists() and any(source.glob(f"*{LOG_SUFFIX}"))
    return source.suffix == LOG_SUFFIX
