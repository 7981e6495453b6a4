"""A store of results: a folder or a bucket, through fsspec.

A task is done when its document ``results/KEY.json`` is there. Its files go to a folder of their own first, and the
document that names them is created last, once: of two attempts at a time the first one to commit counts, and readers
never see half a result. Nothing is locked, so nothing is left locked by what was killed.

Layout:

    fleet.json                 says that this is a store
    results/KEY.json           a result
    files/KEY/ATTEMPT/NAME     its files
    failures/KEY.json          a log that failed, until it is done
    weights/DIGEST/NAME        weights that were given
    sources/ID                 digest of a log, by its URL, size and version
"""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet.urls import MissingError, is_url, open_url, reaching, shown

MARK = "fleet.json"
_MARK_CONTENT = b'{"format": "semantic-mapper-fleet", "version": 2}\n'
_BATCH = 256  # documents that are read together; bounds memory

DocumentT = TypeVar("DocumentT", bound=msgspec.Struct)


class Event(msgspec.Struct, frozen=True):
    """Something in a log that a person may want to look at.

    Args:
        kind: "note", "refused" and "damaged" (replay, eval), "unlabelled" (autolabel), "keyframes" (finetune).
        text: What happened.
        seq: Of the frame, -1 where it is of no single frame.
        stamp_ns: Of the frame, 0 where it is of no single frame.
    """

    kind: str
    text: str
    seq: int = -1
    stamp_ns: int = 0


class MethodScores(msgspec.Struct, frozen=True):
    """How well one method labelled a log.

    Args:
        method: "replay", or a method of ``eval`` such as "sray" or "own image alone".
        iou: Intersection over union, 0..1, by class.
        names: L names of classes of ``stretches``.
        stretches: (S, 3, L) pixels of S stretches of consecutive scored frames, which comparisons draw again: by class
            hits, truth, and union of truth and prediction.
        first: (S,) numbers of the first scored frames of the stretches.
    """

    method: str
    iou: dict[str, float | None]
    names: tuple[str, ...] = ()
    stretches: tuple[tuple[tuple[int, ...], ...], ...] = ()
    first: tuple[int, ...] = ()


class Findings(msgspec.Struct, frozen=True):
    """What an operation has found in a log: the same for the same input, but for ``costs``.

    Args:
        metrics: Figures by name, such as "miou", "map_miou", "frames_fused"; None where there was nothing to score.
        costs: Seconds and bytes of this run by name, such as "step_ms_p50".
        scores: Of each method; the metric "miou" is of the first one.
        events: See there.
    """

    metrics: dict[str, float | None]
    costs: dict[str, float | None] = {}
    scores: tuple[MethodScores, ...] = ()
    events: tuple[Event, ...] = ()


class ResultFile(msgspec.Struct, frozen=True):
    """Size and SHA-256 of a file of a result."""

    bytes: int
    sha256: str


class TaskResult(msgspec.Struct, frozen=True, kw_only=True):
    """``results/KEY.json``; that it is there says that the task is done.

    Args:
        key: Digest of all that decides the result: operation, content of the log, weights, settings, code.
        operation: "replay", "eval", "autolabel", "finetune" or "refine".
        log: URL of the log, without credentials.
        log_digest: SHA-256 of its content.
        log_bytes: Its size.
        tags: Of the manifest, such as robot, site and date.
        weights: Name of the weights; empty = those that ship with the package.
        settings: What ``--set`` said.
        version: Of the code, for people.
        findings: What was found.
        files: By name below ``folder``.
        folder: Of the files, "files/KEY/ATTEMPT" below the store.
        seconds: That it took, without queueing.
        node: Host that ran it.
        finished_ns: When, nanoseconds since 1970.
    """

    key: str
    operation: str
    log: str
    log_digest: str
    log_bytes: int
    tags: dict[str, str]
    weights: str
    settings: dict[str, Any]
    version: str
    findings: Findings
    files: dict[str, ResultFile]
    folder: str
    seconds: float
    node: str
    finished_ns: int


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """``failures/KEY.json``: a log that failed, and was not done since.

    Args:
        key: Digest of operation, URL, weights and settings: no result's key.
        operation, log, tags, version: As in ``TaskResult``.
        error: What went wrong.
        finished_ns: When, nanoseconds since 1970.
    """

    key: str
    operation: str
    log: str
    tags: dict[str, str]
    version: str
    error: str
    finished_ns: int


class Store:
    """Reads and writes a store.

    Args:
        url: Path or URL, such as ``runs/fleet``, ``s3://bucket/fleet`` or ``gs://bucket/fleet``.
        create: Make it where nothing is.

    Raises:
        ConfigError: no store is there, or one of another version.
        StoreError: it cannot be reached.
        DependencyError: no package for this kind of URL.
    """

    def __init__(self, url: str, *, create: bool = False) -> None:
        self.shown = shown(url)
        if is_url(url) and "?" in self.shown:
            raise ConfigError(f"{self.shown}: the URL of a folder cannot have a query or fragment")
        self._fs, self._root = open_url(url)
        self.local = Path(self._root) if "file" in self._fs.protocol else None
        self.url = url if self.local is None else str(self.local)  # tasks run in other folders
        mark = self.find(MARK)
        if mark is None and not create:
            raise ConfigError(f"{self.shown}: is no fleet store; give what `fleet run --out` has written")
        if mark is None:
            if self.local is not None and (self.local.is_file() or self.names("")):
                raise ConfigError(f"{self.shown}: is there and no fleet store; choose another --out")
            self.create(MARK, _MARK_CONTENT)
        elif mark != _MARK_CONTENT:
            raise ConfigError(f"{self.shown}/{MARK}: is damaged or of another version; choose another --out")

    # Objects

    def find(self, name: str) -> bytes | None:
        """All bytes of an object; None where it is missing."""
        try:
            with reaching(f"{self.shown}/{name}"):
                return self._fs.cat_file(self._path(name))
        except MissingError:
            return None

    def exists(self, name: str) -> bool:
        """Whether an object is there; asks the store, not a cache."""
        self._fs.invalidate_cache()
        with reaching(f"{self.shown}/{name}"):
            return bool(self._fs.exists(self._path(name)))

    def names(self, folder: str) -> list[str]:
        """Names of what is directly below a folder, sorted; empty where it is missing."""
        self._fs.invalidate_cache()
        try:
            with reaching(f"{self.shown}/{folder}"):
                found = self._fs.ls(self._path(folder), detail=False)
        except MissingError:
            return []
        names = (str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in found)
        return sorted(name for name in names if name and not name.startswith("."))

    def create(self, name: str, data: bytes) -> bool:
        """Write an object where none is yet, whole or not at all.

        Returns:
            Whether this call has made it. Buckets without conditional writes let a second writer of the same moment
            replace what the first wrote; both are whole.
        """
        if self.exists(name):
            return False
        try:
            with reaching(f"{self.shown}/{name}"):
                if self.local is not None:
                    self._place(self.local / name, data, os.link)
                else:
                    self._fs.pipe_file(self._path(name), data, mode="create")
        except FileExistsError:
            return False
        except StoreError:
            if self.exists(name):  # not every server says in the same way that something is there
                return False
            raise
        return True

    def write(self, name: str, data: bytes) -> None:
        """Write an object, whole or not at all; replaces one that is there."""
        with reaching(f"{self.shown}/{name}"):
            if self.local is not None:
                self._place(self.local / name, data, os.replace)
            else:
                self._fs.pipe_file(self._path(name), data)

    def _place(self, target: Path, data: bytes, place: Any) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        draft = target.with_name(f".{target.name}.{secrets.token_hex(6)}.part")
        try:
            with draft.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            try:
                place(draft, target)
            except OSError as error:
                if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
                    raise
                os.replace(draft, target)  # a file system without hard links
        finally:
            draft.unlink(missing_ok=True)

    def upload(self, file: Path, name: str) -> None:
        """Copy a local file into the store."""
        with reaching(f"{self.shown}/{name}"):
            if self.local is not None:
                (self.local / name).parent.mkdir(parents=True, exist_ok=True)
            self._fs.put_file(str(file), self._path(name))

    def download(self, name: str, file: Path) -> None:
        """Copy an object to a local file.

        Raises:
            StoreError: it is missing, or the store cannot be reached.
        """
        with reaching(f"{self.shown}/{name}"):
            self._fs.get_file(self._path(name), str(file))

    def remove(self, name: str) -> None:
        """Delete an object, or all below a folder; it may be missing."""
        with reaching(f"{self.shown}/{name}"):
            if self.local is not None and (self.local / name).is_dir():
                shutil.rmtree(self.local / name, ignore_errors=True)
                return
            for path in self._fs.find(self._path(name)):
                self._fs.rm_file(path)  # not ``rm``, which takes names for patterns

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}".rstrip("/")

    # Results

    def result(self, key: str) -> TaskResult | None:
        """Of a task; None where it is not done.

        Raises:
            ConfigError: it is damaged, or of another task.
        """
        data = self.find(f"results/{key}.json")
        return None if data is None else self._result(f"results/{key}.json", data)

    def results(self) -> Iterator[TaskResult]:
        """Of all tasks that are done, by key; a bounded number is in memory.

        Raises:
            ConfigError: one is damaged, or of another task.
        """
        for name, data in self._documents("results"):
            yield self._result(name, data)

    def failures(self) -> Iterator[Failure]:
        """Of all logs that failed and were not done since.

        Raises:
            ConfigError: one is damaged.
        """
        for name, data in self._documents("failures"):
            yield _decode(data, Failure, f"{self.shown}/{name}")

    def commit(self, result: TaskResult) -> bool:
        """Make a result count; False where another attempt was quicker, and the files of this one are removed."""
        if not self.create(f"results/{result.key}.json", encode_document(result)):
            winner = self.result(result.key)
            if winner is None or winner.folder != result.folder:  # else it was written, and the answer was lost
                self.remove(result.folder)
                return False
        if self.local is not None:  # what killed attempts have left
            for name in self.names(f"files/{result.key}"):
                if f"files/{result.key}/{name}" != result.folder:
                    self.remove(f"files/{result.key}/{name}")
        return True

    def _documents(self, folder: str) -> Iterator[tuple[str, bytes]]:
        names = [f"{folder}/{name}" for name in self.names(folder)]
        for start in range(0, len(names), _BATCH):
            batch = names[start : start + _BATCH]
            whole = [None] * len(batch)
            with reaching(f"{self.shown}/{folder}"):  # not ``cat``, which takes names for patterns
                found = self._fs.cat_ranges([self._path(name) for name in batch], whole, whole, on_error="return")
            for name, data in zip(batch, found, strict=True):
                again = data if isinstance(data, bytes) else self.find(name)
                if again is not None:
                    yield name, again

    def _result(self, name: str, data: bytes) -> TaskResult:
        result = _decode(data, TaskResult, f"{self.shown}/{name}")
        if name != f"results/{result.key}.json":
            raise ConfigError(
                f"{self.shown}/{name}: is the result of another task ({result.key}, {result.log}); delete it, and "
                "`fleet run` does the task again"
            )
        return result


def is_store(url: str) -> bool:
    """Whether a path or URL names a store."""
    fs, path = open_url(url)
    with reaching(url):
        return bool(fs.exists(f"{path}/{MARK}"))


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def encode_document(document: TaskResult | Failure) -> bytes:
    """As JSON."""
    return msgspec.json.format(msgspec.json.encode(document), indent=1)


def _decode(data: bytes, kind: type[DocumentT], where: str) -> DocumentT:
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: is damaged ({error}); delete it, and `fleet run` does the task again") from error
