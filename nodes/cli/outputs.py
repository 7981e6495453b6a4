"""Where results go is made sure of before minutes are spent on them."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import structlog

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import remove_stale
from semantic_mapper.nodes.cli.console import stderr_console

_log = structlog.get_logger(__name__)


def prepare_file(path: Path) -> None:
    """Make sure that a file can be written, before minutes are spent on what is to be in it.

    Raises:
        ConfigError: it is a folder, or nothing can be written beside it.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file")
    prepare_folder(path.parent)


def prepare_folder(out: Path) -> None:
    """Make the folder for results, before minutes are spent on them.

    Raises:
        ConfigError: it cannot be made or written to.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ConfigError(f"{out}: cannot hold the results ({error.strerror}); choose another folder") from error


def say_replaced(path: Path) -> None:
    """One line on stderr where a file of results is there already: what this run finds will replace it."""
    if path.exists():
        stderr_console().print(
            f"{path}: of an earlier run; will be replaced (--out names another file)", soft_wrap=True
        )


def free_name(path: Path) -> Path:
    """The path, or the first of "NAME-1", "NAME-2", ... where nothing is yet."""
    names = (path, *(path.with_stem(f"{path.stem}-{n}") for n in range(1, 1000)))
    return next(p for p in names if not p.exists())


@contextmanager
def folder_for_results(out: Path) -> Iterator[None]:
    """Make the folder, and remove it again where an error leaves it empty.

    Raises:
        ConfigError: it cannot be made or written to.
    """
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
    """Make the folder for results, and keep other runs out of it for as long as this one lasts.

    Where an error leaves a new folder empty, it is removed again.

    Raises:
        ConfigError: it cannot be made or written to, or another run writes its results there.
    """
    with folder_for_results(out), _lock(out):
        for left in remove_stale(out):
            _log.info("unfinished_file_removed", path=str(left))
        yield


@contextmanager
def _lock(out: Path) -> Iterator[None]:
    folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{out}: another run writes its results there; choose another folder (--out), or wait until it ends"
            ) from None
        except OSError as error:  # file systems without locks
            _log.warning("folder_not_held", folder=str(out), reason=error.strerror)
        yield
    finally:
        os.close(folder)
