"""A store of results: a folder or a bucket, through fsspec.

A task is done when its ``result.json`` is there. Files of an attempt go to a folder of its own first, and the document
that names them is created last, once: of two attempts at a time the first one to commit counts, and readers never see
half a result. Nothing is locked, so nothing is left locked by what was killed.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet.results import (
    Failure,
    TaskResult,
    decode_failure,
    decode_result,
    encode_document,
)
from semantic_mapper.nodes.fleet.urls import TRIES, persistently, shown, split_store_url, split_url

STORE_FORMAT = "semantic-mapper-fleet"
STORE_VERSION = 1
RESULT_FILE = "result.json"
_MARK = "fleet.json"
_AT_ONCE = 256  # documents that are read together; bounds memory

_OF_RESULT = re.compile(r"(?P<task>.*/results/(?P<key>[0-9a-f]{40}))/(?P<attempt>[^/]+)/(?P<name>[^?#]+)", re.DOTALL)

_T = TypeVar("_T")


def batched(items: Iterable[_T], size: int) -> Iterator[list[_T]]:
    """Lists of ``size`` items each, the last one shorter."""
    rest = iter(items)
    while batch := list(islice(rest, size)):
        yield batch


class Store:
    """Reads and writes a store.

    Args:
        url: Path or URL, such as ``runs/fleet``, ``s3://bucket/fleet`` or ``gs://bucket/fleet``.
        create: Make it where nothing is.

    Raises:
        ConfigError: no store is there, or it is of a newer version.
        StoreError: it cannot be reached.
        DependencyError: no package for this kind of URL.
    """

    def __init__(self, url: str, *, create: bool = False) -> None:
        self.shown = shown(url)
        self._fs, self._root = split_store_url(url)
        self.local = Path(self._root) if "file" in self._fs.protocol else None
        self.url = url if self.local is None else str(self.local)  # tasks run in other folders
        self._check_mark(create=create)

    def _check_mark(self, *, create: bool) -> None:
        mark = {"format": STORE_FORMAT, "version": STORE_VERSION}
        if self.local is not None and self.local.is_file():
            raise ConfigError(f"{self.shown}: is a file, no fleet store; choose another --out")
        data = self._read_or_none(_MARK)
        if data is None:
            if not create:
                raise ConfigError(f"{self.shown}: is no fleet store; give what `fleet run --out` has written")
            if self.local is not None and self.names(""):
                raise ConfigError(f"{self.shown}: is there and no fleet store; choose another --out")
            self.create(_MARK, msgspec.json.encode(mark))
            return
        try:
            found = msgspec.json.decode(data)
            version = int(found["version"]) if found["format"] == STORE_FORMAT else None
        except (msgspec.DecodeError, KeyError, TypeError, ValueError):
            version = None
        if version is None:
            raise ConfigError(f"{self.shown}/{_MARK}: is damaged or of something else; choose another --out")
        if version > STORE_VERSION:
            raise ConfigError(f"{self.shown}: is of version {version}, this one reads {STORE_VERSION}; upgrade")

    # Objects

    def _try(self, name: str, call: Callable[[], _T], tries: int | None = None) -> _T:
        """Do it, again after pauses where the store could not be reached.

        Raises:
            StoreError: it cannot be reached, or refuses.
            FileNotFoundError, FileExistsError: as they say.
        """
        return persistently(call, f"{self.shown}/{name}" if name else self.shown, tries or (1 if self.local else TRIES))

    def path(self, name: str) -> str:
        """Of an object, as the file system takes it."""
        return f"{self._root}/{name}"

    def read(self, name: str) -> bytes:
        """All bytes of an object.

        Raises:
            StoreError: it is missing, or the store cannot be reached.
        """
        data = self._read_or_none(name)
        if data is None:
            raise StoreError(f"{self.shown}/{name}: is missing")
        return data

    def _read_or_none(self, name: str) -> bytes | None:
        try:
            return self._try(name, lambda: self._fs.cat_file(self.path(name)))
        except FileNotFoundError:
            return None

    def exists(self, name: str) -> bool:
        """Whether an object is there; asks the store, not a cache."""
        try:
            self._fs.invalidate_cache()
            self._try(name, lambda: self._fs.info(self.path(name)))
        except FileNotFoundError:
            return False
        return True

    def write(self, name: str, data: bytes, *, tries: int | None = None) -> None:
        """Write an object, whole or not at all; replaces one that is there."""
        if self.local is not None:
            target = self.local / name
            self._try(name, lambda: self._place(target, data, os.replace))
        else:
            self._try(name, lambda: self._fs.pipe_file(self.path(name), data), tries)

    def create(self, name: str, data: bytes) -> bool:
        """Write an object where none is yet, whole or not at all.

        Returns:
            Whether this call has made it. Stores without conditional writes let a second writer of the same moment
            replace what the first wrote; both are whole.
        """
        if self.local is None and self.exists(name):
            return False
        target = None if self.local is None else self.local / name
        try:
            if target is not None:
                self._try(name, lambda: self._place(target, data, _link))
            else:
                self._try(name, lambda: self._create_remote(name, data))
        except FileExistsError:
            return False
        return True

    def _create_remote(self, name: str, data: bytes) -> None:
        try:
            self._fs.pipe_file(self.path(name), data, mode="create")
        except OSError as error:  # servers do not all say in the same words that something is there
            if self._fs.exists(self.path(name)):
                raise FileExistsError(name) from error
            raise

    def upload(self, file: Path, name: str) -> None:
        """Copy a local file into the store."""
        if self.local is not None:
            (self.local / name).parent.mkdir(parents=True, exist_ok=True)
        self._try(name, lambda: self._fs.put_file(str(file), self.path(name)))

    def take(self, file: Path, name: str) -> None:
        """As ``upload``, for a file that is not needed any more: moved where that is cheaper."""
        if self.local is None:
            self.upload(file, name)
            return
        target = self.local / name
        self._try(name, lambda: _move(file, target))

    def download(self, name: str, file: Path) -> None:
        """Copy an object to a local file.

        Raises:
            StoreError: it is missing, or the store cannot be reached.
        """
        try:
            self._try(name, lambda: self._fs.get_file(self.path(name), str(file)))
        except FileNotFoundError as error:
            raise StoreError(f"{self.shown}/{name}: is missing") from error

    def remove(self, name: str, *, folder: bool = False) -> None:
        """Delete an object or all below a folder; it may be missing."""
        with suppress(FileNotFoundError):
            self._try(name, lambda: self._remove(name, folder=folder))

    def _remove(self, name: str, *, folder: bool) -> None:
        if self.local is not None:
            if folder:
                shutil.rmtree(self.local / name)
            else:
                (self.local / name).unlink()
            return
        for path in self._fs.find(self.path(name)) if folder else [self.path(name)]:
            self._fs.rm_file(path)  # not ``rm``, which takes names for patterns

    def names(self, folder: str) -> list[str]:
        """Names of what is directly below a folder, sorted; empty where it is missing."""
        self._fs.invalidate_cache()
        try:
            found = self._try(folder, lambda: self._fs.ls(self.path(folder), detail=False))
        except FileNotFoundError:
            return []
        names = (str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in found)
        return sorted(name for name in names if name and not name.startswith("."))

    def read_many(self, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Objects by name, some at once; missing ones are left out."""
        for batch in batched(names, _AT_ONCE):
            paths = {self.path(name): name for name in batch}
            whole = [None] * len(paths)
            # Not ``cat``, which takes names for patterns.
            found: list[Any] = self._try(
                "",
                lambda: self._fs.cat_ranges(list(paths), whole, whole, on_error="return"),  # noqa: B023
            )
            for name, data in zip(paths.values(), found, strict=True):
                if isinstance(data, bytes):
                    yield name, data
                elif (again := self._read_or_none(name)) is not None:  # with retries
                    yield name, again

    # Results

    def result(self, key: str) -> TaskResult | None:
        """Of a task; None where it is not done.

        Raises:
            ConfigError: it is damaged, or of another task.
        """
        name = f"results/{key}/{RESULT_FILE}"
        data = self._read_or_none(name)
        return None if data is None else _result_of(key, data, f"{self.shown}/{name}")

    def read_result_file(self, folder: str, name: str) -> bytes:
        """All bytes of a file of a result.

        Args:
            folder: Of the result, "results/KEY/ATTEMPT".
            name: Below it.

        Raises:
            ConfigError: the result is damaged, or of another task.
            StoreError: file or result is missing, the file is not what the result names, or the store cannot be
                reached.
        """
        data = self.read(f"{folder}/{name}")
        result = self.result(folder.split("/")[1] if "/" in folder else "")
        _check_file(result, folder, name, hashlib.sha256(data).hexdigest(), f"{self.shown}/{folder}/{name}")
        return data

    def keys(self) -> list[str]:
        """Of all tasks that were begun, sorted; ``results`` leaves out those that are not done."""
        return self.names("results")

    def results(self, keys: Iterable[str] | None = None) -> Iterator[TaskResult]:
        """Of all tasks that are done, or of those among ``keys``; a bounded number is in memory.

        Raises:
            ConfigError: one is damaged, or of another task.
        """
        names = (f"results/{key}/{RESULT_FILE}" for key in (self.keys() if keys is None else keys))
        for name, data in self.read_many(names):
            yield _result_of(name.split("/")[1], data, f"{self.shown}/{name}")

    def commit(self, result: TaskResult) -> bool:
        """Make a result count; False where another attempt has been quicker, and this one's files are removed."""
        if self.create(f"results/{result.key}/{RESULT_FILE}", encode_document(result)):
            if self.local is not None:  # elsewhere another attempt might still replace this result by its own
                self._remove_other_attempts(result)
            return True
        winner = self.result(result.key)
        if winner is not None and winner.folder == result.folder:
            return True  # it was written, and only the answer was lost
        self.remove(result.folder, folder=True)
        return False

    def _remove_other_attempts(self, result: TaskResult) -> None:
        """What killed attempts have left."""
        for name in self.names(f"results/{result.key}"):
            if name != RESULT_FILE and f"results/{result.key}/{name}" != result.folder:
                self.remove(f"results/{result.key}/{name}", folder=True)

    def quarantine(self, failure: Failure) -> None:
        """Note that a task failed for good."""
        self.write(f"failed/{failure.key}.json", encode_document(failure))

    def release(self, key: str) -> None:
        """Take a task out of quarantine."""
        self.remove(f"failed/{key}.json")

    def failures(self) -> Iterator[Failure]:
        """All quarantined tasks."""
        for name, data in self.read_many(f"failed/{name}" for name in self.names("failed")):
            yield decode_failure(data, f"{self.shown}/{name}")

    def _place(self, target: Path, data: bytes, place: Callable[[Path, Path], None]) -> None:
        """Write the data beside its target under a name of its own, then put it in place in one step.

        Not ``files.atomic_write``, which looks through the folder for leftovers: folders here have thousands of files.
        """
        target.parent.mkdir(parents=True, exist_ok=True)
        draft = target.with_name(f".{target.name}.{secrets.token_hex(6)}.part")
        try:
            with draft.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            place(draft, target)
        finally:
            draft.unlink(missing_ok=True)


def _link(draft: Path, target: Path) -> None:
    """Put a draft in place where nothing is."""
    try:
        os.link(draft, target)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        if target.exists():  # a file system without hard links
            raise FileExistsError(str(target)) from error
        os.replace(draft, target)


def _move(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(file, target)


def _result_of(key: str, data: bytes, where: str) -> TaskResult:
    result = decode_result(data, where)
    if result.key != key or not result.folder.startswith(f"results/{key}/"):
        raise ConfigError(
            f"{where}: is the result of another task ({result.key}, {result.log}); delete it, and `fleet run` does the "
            "task again"
        )
    return result


def _check_file(result: TaskResult | None, folder: str, name: str, digest: str, where: str) -> None:
    if result is None:
        raise StoreError(f"{where}: its result is missing; `fleet run` does the task again")
    file = result.files.get(name) if result.folder == folder else None
    if file is None or file.sha256 != digest:
        raise StoreError(
            f"{where}: is damaged, or not the file that {RESULT_FILE} names; delete that, and `fleet run` does "
            "the task again"
        )


def check_result_file(url: str, digest: str) -> None:
    """Check a file that was read against its result, where it is one of a store: "STORE/results/KEY/ATTEMPT/NAME".

    Args:
        url: Path or URL of the file.
        digest: SHA-256 of what was read.

    Raises:
        ConfigError: the result is damaged, or of another task.
        StoreError: it is not the file that the result names, or the store cannot be reached.
    """
    fs, path = split_url(url)
    match = _OF_RESULT.fullmatch(path)
    if match is None:
        return
    where = shown(url)
    try:
        data = persistently(lambda: fs.cat_file(f"{match['task']}/{RESULT_FILE}"), where)
    except FileNotFoundError:
        return
    result = _result_of(match["key"], data, where)
    _check_file(result, f"results/{match['key']}/{match['attempt']}", match["name"], digest, where)


def open_store(url: str) -> Store:
    """The store of a task, on the machine of its worker.

    Raises:
        StoreError: it cannot be reached, or this machine does not have the driver's folder.
    """
    try:
        return Store(url)
    except ConfigError as error:
        raise StoreError(
            f"{socket.gethostname()}: {error}. Where nodes share no folder of this name, --out must be a bucket"
        ) from error
