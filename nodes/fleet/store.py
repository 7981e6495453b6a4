"""Logs and results of a fleet, in folders and buckets: fsspec opens both.

A task is done when its document ``results/KEY.json`` is in the store. Its files go to a folder of their own first, and
the document that names them is written last, in one step, so that readers never see half a result. Nothing is locked.

    fleet.json                 says that this is a store
    results/KEY.json           a result
    files/KEY/ATTEMPT/NAME     its files
    failures/KEY.json          a log that failed, until it is done
    sources/ID                 digest of a log, by its URL, size and version
"""

import csv
import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from semantic_mapper.errors import ConfigError, DependencyError, FleetError, SemanticMapperError, StoreError
from semantic_mapper.files import write_bytes
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.replay.run_folder import LOG_SUFFIX, STORE_MARK

_SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://")
_MARK_CONTENT = b'{"format": "semantic-mapper-fleet", "version": 3}\n'
_BATCH = 256  # documents that are read together; bounds memory
_READERS = 16  # requests at a time


class MissingError(StoreError):
    """There is no such file or object."""


class MethodScores(msgspec.Struct, frozen=True):
    """How well one method labelled a log."""

    method: str  # "map", or a method of ``eval`` such as "sray" or "own image alone"
    iou: dict[str, float | None]  # intersection over union, 0..1, by class


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
    operation: str  # "map", "eval", "autolabel" or "finetune"
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

    Raises ConfigError: no store is there, or one of another version. StoreError: it cannot be reached. DependencyError:
    no package for this kind of URL.

    ``url`` may be a path, such as ``runs/fleet`` or ``s3://bucket/fleet``; ``create`` makes it where nothing is.
    """

    def __init__(self, url: str, *, create: bool = False) -> None:
        self.shown = without_secrets(url)
        if is_url(url) and "?" in self.shown:
            raise ConfigError(f"{self.shown}: the URL of a folder cannot have a query or fragment")
        self._fs, self._root = open_url(url)
        self._local = Path(self._root) if "file" in self._fs.protocol else None
        self.url = url if self._local is None else self._root  # tasks run in other folders
        mark = self.find(STORE_MARK)
        if mark is None and not create:
            raise ConfigError(f"{self.shown}: is no fleet store; give what `fleet run --out` has written")
        if mark not in (None, _MARK_CONTENT) or (mark is None and self._local is not None and self.names("")):
            raise ConfigError(f"{self.shown}: is there, and no fleet store of this version; choose another --out")
        if mark is None:
            self.write(STORE_MARK, _MARK_CONTENT)

    def find(self, name: str) -> bytes | None:
        """All bytes of an object as it is now; None where it is missing."""
        try:
            with reaching(f"{self.shown}/{name}"):
                return self._fs.cat_file(f"{self._root}/{name}")
        except MissingError:
            return None

    def names(self, folder: str) -> list[str]:
        """Names of what is directly below a folder, sorted; empty where it is missing."""
        self._fs.invalidate_cache()
        try:
            with reaching(f"{self.shown}/{folder}"):
                found = self._fs.ls(f"{self._root}/{folder}".rstrip("/"), detail=False)
        except MissingError:
            return []
        names = (str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in found)
        return sorted(name for name in names if name and not name.startswith("."))

    def write(self, name: str, data: bytes) -> None:
        """Write an object, whole or not at all; replaces one that is there."""
        with reaching(f"{self.shown}/{name}"):
            if self._local is None:
                self._fs.pipe_file(f"{self._root}/{name}", data)
            else:
                (self._local / name).parent.mkdir(parents=True, exist_ok=True)
                write_bytes(self._local / name, data)

    def upload(self, file: Path, name: str) -> None:
        """Copy a local file into the store."""
        with reaching(f"{self.shown}/{name}"):
            if self._local is not None:
                (self._local / name).parent.mkdir(parents=True, exist_ok=True)
            self._fs.put_file(str(file), f"{self._root}/{name}")

    def remove(self, name: str) -> None:
        """Delete an object, or all below a folder; it may be missing."""
        with reaching(f"{self.shown}/{name}"):
            for path in self._fs.find(f"{self._root}/{name}"):
                self._fs.rm_file(path)  # not ``rm``, which takes names for patterns

    def results(self) -> Iterator[TaskResult]:
        """Of all tasks that are done, by key; ``ConfigError`` where one is damaged."""
        return self._records("results", TaskResult)

    def failures(self) -> Iterator[Failure]:
        """Of all logs that failed and were not done since; ``ConfigError`` where one is damaged."""
        return self._records("failures", Failure)

    def commit(self, result: TaskResult) -> bool:
        """Make a result count; False where another attempt was quicker, and the files of this one are removed."""
        name = f"results/{result.key}.json"
        if self.find(name) is not None:
            self.remove(result.folder)
            return False
        self.write(name, _encode(result))
        return True

    def note_failure(self, failure: Failure) -> None:
        """Keep a failure until its log is done."""
        self.write(f"failures/{failure.key}.json", _encode(failure))

    def _records(self, folder: str, kind: type[RecordT]) -> Iterator[RecordT]:
        names = [f"{folder}/{name}" for name in self.names(folder)]
        with ThreadPoolExecutor(_READERS) as readers:
            for start in range(0, len(names), _BATCH):
                batch = names[start : start + _BATCH]
                for name, data in zip(batch, list(readers.map(self.find, batch)), strict=True):
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
    if not is_url(url):
        return Path(url, STORE_MARK).is_file()
    fs, path = open_url(url)
    with reaching(url):
        return bool(fs.exists(f"{path}/{STORE_MARK}"))


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _encode(record: Record) -> bytes:
    return msgspec.json.format(msgspec.json.encode(record), indent=1)


def fleet_package(name: str) -> Any:
    """A module of a package of the extra ``fleet``; ``DependencyError`` where it is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise DependencyError(f"a fleet needs more packages ({error}): pip install 'semantic-mapper[fleet]'") from error


# Paths and URLs


def is_url(text: str) -> bool:
    """Whether a URL is meant rather than a local path."""
    return _SCHEME.match(text) is not None


def open_url(url: str) -> tuple[Any, str]:
    """The fsspec file system of a path or URL, and the path in it, without a slash at its end.

    Raises ConfigError: no such scheme, or no address. FleetError: a key, token or password in the URL. DependencyError:
    the extra ``fleet``, or the package for this scheme, is missing.
    """
    url_to_fs = fleet_package("fsspec.core").url_to_fs
    place = re.split(r"[?#]", url, maxsplit=1)[0]
    if is_url(url) and without_secrets(place) != place:  # it would be in the shell's history and in the process table
        raise FleetError(
            f"{without_secrets(url)}: a URL must not hold a key, token or password; give it to every node in its "
            "environment (AWS_ACCESS_KEY_ID, ...), in ~/.aws, or in fsspec's configuration (~/.config/fsspec)"
        )
    if not is_url(url) or url.startswith("file://"):
        url = str(Path(url.removeprefix("file://")).absolute())
    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise DependencyError(f"{without_secrets(url)}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{without_secrets(url)}: cannot be opened ({error})") from error
    return fs, str(path).rstrip("/")


def full_url(fs: Any, path: str, like: str) -> str:
    """URL of a path in a file system; ``like`` is a URL or path of the same one."""
    return str(fs.unstrip_protocol(path)) if is_url(like) and not like.startswith("file:") else path


def fetch(url: str, target: Path) -> Path:
    """A file on this machine: ``target``, to which it is downloaded, where it is elsewhere."""
    if not is_url(url):
        return Path(url)
    fs, path = open_url(url)
    if "file" in fs.protocol:
        return Path(path)
    target.parent.mkdir(exist_ok=True)
    with reaching(url):
        fs.get_file(path, str(target))
    return target


@contextmanager
def reaching(url: str) -> Iterator[None]:
    """Errors of requests as ``StoreError``, of what is missing as ``MissingError``; neither shows what signs a URL."""
    shown = without_secrets(url)
    try:
        yield
    except SemanticMapperError:
        raise
    except FileNotFoundError as error:
        raise MissingError(f"{shown}: is missing") from error
    except Exception as error:  # packages of buckets raise errors of their own, which share no base
        reason = without_secrets(f"{type(error).__name__}: {error.__cause__ or error}")
        raise StoreError(
            f"{shown}: cannot be reached or written ({reason}); check the path, and who may read and write it"
        ) from error


# Logs


class LogInput(msgspec.Struct, frozen=True):
    """One log, or one recording in parts, or one map."""

    url: str  # path or URL of a file, or of a folder with the parts of one recording
    tags: dict[str, str] = {}  # what a manifest says of it, such as robot, site and date


def find_inputs(arguments: Sequence[str]) -> list[LogInput]:
    """Every log that is meant, once each, in the order of the arguments.

    A glob stands for the files that it matches (``site/*.mcap``) or, with a slash at its end, for folders
    (``site/*/``); a folder is the parts of one recording, as for ``map``. A manifest is CSV with a column ``log``
    (relative paths count from the manifest) and any others, which become tags. Whether a log can be read is found out
    by its task. Raises ConfigError: a glob matches nothing, a path is missing, a manifest cannot be used, or there is
    no log at all. StoreError: something cannot be reached.
    """
    found: dict[str, LogInput] = {}
    for argument in arguments:
        is_manifest = argument.lower().endswith(".csv")
        for item in _read_manifest(argument) if is_manifest else map(LogInput, _expand(argument)):
            if item.tags or item.url not in found:
                found[item.url] = item
    if not found:
        raise ConfigError("no logs are given; name some, as paths, URLs, globs or manifests")
    return list(found.values())


def _expand(argument: str) -> list[str]:
    fs, path = open_url(argument)
    if not is_url(argument) and os.path.exists(path):  # letters of globs may stand in names
        return [path]
    if re.search(r"[*?[]", path) and not argument.startswith(("http://", "https://")):
        wanted, ending = ("directory", "") if argument.endswith("/") else ("file", LOG_SUFFIX)
        with reaching(argument):
            matches = fs.glob(path, detail=True)
        names = [name for name, info in matches.items() if info["type"] == wanted and name.lower().endswith(ending)]
        if not names:
            raise ConfigError(f"{argument}: matches no {wanted} {ending}; put the pattern in quotes, try it with `ls`")
        return [full_url(fs, name, argument) for name in sorted(names)]
    if is_url(argument):
        return [argument]
    raise ConfigError(f"{argument}: no such log; give a path, a URL, a glob or a manifest")


def _read_manifest(argument: str) -> Iterator[LogInput]:
    fs, path = open_url(argument)
    base = (argument if is_url(argument) else path).rsplit("/", 1)[0]
    try:
        with reaching(argument):
            data = fs.cat_file(path)
        reader = csv.DictReader(data.decode("utf-8-sig").splitlines(), strict=True)
        for row in reader:
            log = (row.pop("log", "") or "").strip()
            if not log or None in row or None in row.values():
                raise ConfigError(
                    f"{argument}: line {reader.line_num} must have a path or URL in the column 'log', and as many "
                    "columns as the first line"
                )
            url = log if is_url(log) or log.startswith("/") else f"{base}/{log}"
            yield LogInput(url, {name: value for name, value in row.items() if value})
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{without_secrets(argument)}: is no CSV in UTF-8 ({error})") from error
