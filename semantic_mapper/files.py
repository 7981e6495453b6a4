"""Files that people name: read with a limit, and written so that each is there whole, or as it was before.

What is written goes to a new file next to the one that it becomes, under a name that nobody can foresee, and takes its
place in one step (``rename``): an existing link is replaced, never written through. The new file is locked while it is
written, so that what a killed process has left can be distinguished from what another one is about to finish.
"""

import codecs
import fcntl
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal

from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.plain_text import plain_without_secrets

Sync = Literal["none", "file", "folder"]

_PART = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{12}\.part", re.DOTALL)
_NAME_BYTES = 200  # of the final name that are part of the other one: names end at 255


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file to be read. Pipes, devices and sockets are refused: they may never end, or never begin.

    Raises ConfigError: no regular file. OSError: it is missing or cannot be read; ``filename`` is set.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer must not block
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise ConfigError(f"{path}: is no regular file; copy its content to one")
    return os.fdopen(fd, "rb")


def read_regular(path: Path, limit: int) -> bytes:
    """All bytes of a regular file of at most ``limit`` bytes.

    Raises ConfigError, OSError: as of ``open_regular``; or it is larger.
    """
    with open_regular(path) as file:
        data = file.read(min(os.fstat(file.fileno()).st_size, limit) + 1)
        while len(data) <= limit and (more := file.read(1 << 16)):  # it grows, or is the kernel's and has no size
            data += more
    if len(data) > limit:
        raise ConfigError(f"{path}: is larger than the limit of {limit:,} bytes; is it the right file?")
    return data


def decode_text(data: bytes) -> str:
    """Text of a file: UTF-8, with or without the mark that Windows' programs begin it with, or UTF-16 with its mark.

    Raises UnicodeDecodeError: neither.
    """
    utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if utf16 else "utf-8-sig")


@contextmanager
def atomic_write(
    path: Path, *, sync: Sync = "file", raises: type[SemanticMapperError] | None = None
) -> Iterator[BinaryIO]:
    """Give a file to write; at the end it takes the place of ``path``.

    After an error nothing is left of it, and ``path`` is as it was. Two writers at a time do not mix: the last one to
    end wins. What killed writers of this path have left is removed. Raises OSError: it cannot be written; ``filename``
    is ``path``.

    Args:
        path: Of the file, in a folder that exists. A link is replaced, and what it points to stays as it is.
        sync: What a power cut leaves. "none": anything, for files that live no longer than the machine runs. "file":
            the old file or the new one. "folder": once this has returned, the new one.
        raises: Raised in the place of an ``OSError``.
    """
    with atomic_path(path, sync=sync, raises=raises) as part, part.open("wb") as file:
        yield file


@contextmanager
def atomic_path(path: Path, *, sync: Sync = "file", raises: type[SemanticMapperError] | None = None) -> Iterator[Path]:
    """As ``atomic_write``, for writers that open their file themselves: an empty file to be written to."""
    with _explained(path, raises):
        remove_stale(path.parent, path.name)
        part, lock = _new_part(path)
        try:
            yield part
            if sync != "none":
                _sync(part)
            os.replace(part, path)
            if sync == "folder":
                _sync(path.parent)
        finally:
            part.unlink(missing_ok=True)
            os.close(lock)


@contextmanager
def atomic_folder(path: Path, *, raises: type[SemanticMapperError] | None = None) -> Iterator[Path]:
    """As ``atomic_path``, for a folder, which is not synced: a new one to fill, which becomes ``path``."""
    with _explained(path, raises):
        draft = path.with_name(f".{_cut(path.name)}.{secrets.token_hex(6)}.part")
        draft.mkdir()
        try:
            yield draft
            os.replace(draft, path)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def write_bytes(
    path: Path, data: bytes, *, sync: Sync = "file", raises: type[SemanticMapperError] | None = None
) -> None:
    """``Path.write_bytes`` by ``atomic_write``."""
    with atomic_write(path, sync=sync, raises=raises) as file:
        file.write(data)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write JSON atomically, without secrets of the addresses in it; makes the folder where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, (json.dumps(plain_without_secrets(data), indent=1, allow_nan=False) + "\n").encode())


def open_unlinked(path: str | Path, flags: int) -> int:
    """``os.open`` that follows no link at the end of ``path``, and makes the file where ``flags`` has ``O_CREAT``."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def remove_stale(folder: Path, name: str = "") -> list[Path]:
    """Remove unfinished files that killed processes have left in a folder; those that are being written stay.

    With a name only those that were to become this one. Returns what was removed.
    """
    removed = []
    with suppress(OSError):  # no such folder, or one of somebody else: nothing of ours to remove
        for entry in os.scandir(folder):
            match = _PART.fullmatch(entry.name)
            if match is None or (name and match["name"] != _cut(name)):
                continue
            if _remove_unlocked(entry.path):
                removed.append(Path(entry.path))
    return removed


def _cut(name: str) -> str:
    return os.fsencode(name)[:_NAME_BYTES].decode(errors="ignore")


def _new_part(path: Path) -> tuple[Path, int]:
    """A new file next to ``path``, and its lock."""
    while True:
        part = path.with_name(f".{_cut(path.name)}.{secrets.token_hex(6)}.part")
        lock = open_unlinked(part, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        with suppress(OSError):  # file systems without locks: there nothing is ever taken for stale, either
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_nlink:
            return part, lock
        os.close(lock)  # taken for stale before it was locked


def _remove_unlocked(path: str) -> bool:
    try:
        lock = open_unlinked(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if stat.S_ISREG(os.fstat(lock).st_mode):
            os.unlink(path)
            return True
    except OSError:  # it is being written, or another process was quicker
        return False
    finally:
        os.close(lock)
    return False


@contextmanager
def _explained(path: Path, raises: type[SemanticMapperError] | None) -> Iterator[None]:
    """Errors of the unfinished file are reported as those of ``path``."""
    try:
        yield
    except OSError as error:
        if isinstance(error.filename, str) and _PART.fullmatch(os.path.basename(error.filename)):
            error.filename, error.filename2 = str(path), None
        if raises is None:
            raise
        raise raises(f"{path}: cannot be written: {error.strerror or error}") from error


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def numeric_order(name: str) -> list[str | int]:
    """Key that sorts names by the numbers in them, as people order them: 9 comes before 10."""
    return [int(part) if at % 2 else part for at, part in enumerate(re.split(r"(\d+)", name))]
