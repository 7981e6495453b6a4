"""A store of results: a folder or a bucket, through fsspec.

A task is done when its document ``results/KEY.json`` is there. Its files go to a folder of their own first, and the
document that names them is written last, in one step, so that readers never see half a result. Nothing is locked, so
nothing is left locked by what was killed.

Layout:

    fleet.json                 says that this is a store
    results/KEY.json           a result
    files/KEY/ATTEMPT/NAME     its files
    failures/KEY.json          a log that failed, until it is done
    sources/ID                 digest of a log, by its URL, size and version
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import write_bytes
from semantic_mapper.nodes.fleet.urls import MissingError, is_url, open_url, reaching
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.replay.run_folder import STORE_MARK

_MARK_CONTENT = b'{"format": "semantic-mapper-fleet", "version": 3}\n'
_BATCH = 256  # documents that are read together; bounds memory


class MethodScores(msgspec.Struct, frozen=True):
    """How well one method labelled a log."""

    method: str  # "replay", or a method of ``eval`` such as "sray" or "own image alone"
    iou: dict[str, float | None]  # intersection over union, 0..1, by class
    names: tuple[str, ...] = ()  # L names of classes of ``stretches``
    # (S, 3, L) pixels of S stretches of consecutive scored frames, which comparisons draw again: by class hits, truth,
    # and union of truth and prediction
    stretches: tuple[tuple[tuple[int, ...], ...], ...] = ()
    first: tuple[int, ...] = ()  # (S,) numbers of the first scored frames of the stretches


class Findings(msgspec.Struct, frozen=True):
    """What an operation has found in a log: the same for the same input, but for ``costs``."""

    # figures by name, such as "miou", "map_miou", "frames_fused"; None where there was nothing to score
    metrics: dict[str, float | None]
    costs: dict[str, float | None] = {}  # seconds and bytes of this run by name, such as "step_ms_p50"
    scores: tuple[MethodScores, ...] = ()  # of each method; the metric "miou" is of the first one
    # kind and text of what a person may want to look at, such as a refused frame
    events: tuple[tuple[str, str], ...] = ()


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a log that was worked on."""

    # digest of all that decides a result: operation, content of the log, weights, settings, code. Of a failure: of
    # operation, URL, weights and settings.
    key: str
    operation: str  # "replay", "eval", "autolabel", "finetune" or "refine"
    log: str  # URL of the log, without credentials
    tags: dict[str, str]  # of the manifest, such as robot, site and date
    version: str  # of the code, for people
    finished_ns: int  # when, nanoseconds since 1970


class TaskResult(Record, frozen=True, kw_only=True):
    """``results/KEY.json``; that it is there says that the task is done."""

    log_digest: str  # SHA-256 of the log's content
    weights: str  # name of the weights; empty = those that ship with the package
    settings: dict[str, Any]  # what was set
    findings: Findings  # what was found
    files: dict[str, str]  # SHA-256 by name below ``folder``
    folder: str  # of the files, "files/KEY/ATTEMPT" below the store
    seconds: float  # that it took, without queueing
    node: str  # host that ran it


class Failure(Record, frozen=True, kw_only=True):
    """``failures/KEY.json``: a log that failed, and was not done since; ``error`` says what went wrong."""

    error: str


RecordT = TypeVar("RecordT", bound=Record)


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
        self.shown = without_secrets(url)
        if is_url(url) and "?" in self.shown:
            raise ConfigError(f"{self.shown}: the URL of a folder cannot have a query or fragment")
        self._fs, self._root = open_url(url)
        self._local = Path(self._root) if "file" in self._fs.protocol else None
        self.url = url if self._local is None else str(self._local)  # tasks run in other folders
        mark = self.find(STORE_MARK)
        if mark is None and not create:
            raise ConfigError(f"{self.shown}: is no fleet store; give what `fleet run --out` has written")
        if mark is None:
            if self._local is not None and self.names(""):
                raise ConfigError(f"{self.shown}: is there and no fleet store; choose another --out")
            self.write(STORE_MARK, _MARK_CONTENT)
        elif mark != _MARK_CONTENT:
            raise ConfigError(f"{self.shown}/{STORE_MARK}: is damaged or of another version; choose another --out")

    # Objects

    def find(self, name: str) -> bytes | None:
        """All bytes of an object; None where it is missing."""
        try:
            with reaching(f"{self.shown}/{name}"):
                return self._fs.cat_file(self._path(name))
        except MissingError:
            return None

    def exists(self, name: str) -> bool:
        """Whether an object is there; looks into the store, not into a cache."""
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

    def write(self, name: str, data: bytes) -> None:
        """Write an object, whole or not at all; replaces one that is there."""
        with reaching(f"{self.shown}/{name}"):
            if self._local is None:
                self._fs.pipe_file(self._path(name), data)
            else:
                self._make_folder(name)
                write_bytes(self._local / name, data)

    def upload(self, file: Path, name: str) -> None:
        """Copy a local file into the store."""
        with reaching(f"{self.shown}/{name}"):
            self._make_folder(name)
            self._fs.put_file(str(file), self._path(name))

    def remove(self, name: str) -> None:
        """Delete an object, or all below a folder; it may be missing."""
        with reaching(f"{self.shown}/{name}"):
            for path in self._fs.find(self._path(name)):
                self._fs.rm_file(path)  # not ``rm``, which takes names for patterns

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}".rstrip("/")

    def _make_folder(self, name: str) -> None:
        if self._local is not None:
            (self._local / name).parent.mkdir(parents=True, exist_ok=True)

    # Results

    def results(self) -> Iterator[TaskResult]:
        """Of all tasks that are done, by key; a bounded number is in memory.

        Raises:
            ConfigError: one is damaged.
        """
        return self._records("results", TaskResult)

    def failures(self) -> Iterator[Failure]:
        """Of all logs that failed and were not done since.

        Raises:
            ConfigError: one is damaged.
        """
        return self._records("failures", Failure)

    def commit(self, result: TaskResult) -> bool:
        """Make a result count; False where another attempt was quicker, and the files of this one are removed."""
        name = f"results/{result.key}.json"
        if self.exists(name):
            self.remove(result.folder)
            return False
        self.write(name, _encode(result))
        return True

    def note_failure(self, failure: Failure) -> None:
        """Keep a failure until its log is done."""
        self.write(f"failures/{failure.key}.json", _encode(failure))

    def _records(self, folder: str, kind: type[RecordT]) -> Iterator[RecordT]:
        names = [f"{folder}/{name}" for name in self.names(folder)]
        for start in range(0, len(names), _BATCH):
            batch = names[start : start + _BATCH]
            whole = [None] * len(batch)
            with reaching(f"{self.shown}/{folder}"):  # not ``cat``, which takes names for patterns
                found = self._fs.cat_ranges([self._path(name) for name in batch], whole, whole, on_error="return")
            for name, read in zip(batch, found, strict=True):
                data = read if isinstance(read, bytes) else self.find(name)
                if data is None:
                    continue
                try:
                    yield msgspec.json.decode(data, type=kind)
                except msgspec.DecodeError as error:
                    raise ConfigError(
                        f"{self.shown}/{name}: is damaged ({error}); delete it, and `fleet run` does the task again"
                    ) from error


def is_store(url: str) -> bool:
    """Whether a path or URL names a store."""
    fs, path = open_url(url)
    with reaching(url):
        return bool(fs.exists(f"{path}/{STORE_MARK}"))


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _encode(record: Record) -> bytes:
    return msgspec.json.format(msgspec.json.encode(record), indent=1)
