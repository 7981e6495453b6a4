"""What a worker does with one log: fetch it, see whether the result exists, make it, commit it."""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import msgspec

from semantic_mapper.config import convert_config
from semantic_mapper.errors import FleetError, LogError, SemanticMapperError, StoreError
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.fleet.code_version import code_digest, code_version
from semantic_mapper.nodes.fleet.results import Findings, ResultFile, TaskResult
from semantic_mapper.nodes.fleet.scratch import DiskError, scratch_root, task_folder
from semantic_mapper.nodes.fleet.store import Store, check_result_file, open_store
from semantic_mapper.nodes.fleet.urls import persistently, shown, split_url, unstripped

CHUNK_BYTES = 8 << 20  # of a download; a cut connection costs no more
OUTPUT_BYTES = 256 << 20  # what a task writes beside its log, about
KEY_DIGITS = 40

_log = get_logger(__name__)


class Source(msgspec.Struct, frozen=True):
    """``sources/ID.json``: what was in a log when it had this identity, so that it is not read again.

    Args:
        url: Without credentials.
        identity: Size and version (etag, or time of change) of each of its files.
        digest: SHA-256 of its content.
        size: Bytes.
    """

    url: str
    identity: str
    digest: str
    size: int


class OtherCodeError(FleetError):
    """A worker would not compute what the driver means."""


@dataclass(frozen=True, slots=True)
class Task:
    """One log and what to do with it; goes to a worker, which has nothing else.

    Args:
        operation: Of ``OPERATIONS``.
        url: Of the log.
        tags: Of its manifest.
        store: URL of the store.
        settings: Plain data of the operation's kind.
        shown_settings: What was set, for people.
        weights: Their file's name, or the name of weights that ship with the package; empty = the default ones.
        weights_digest: SHA-256 of the file.
        weights_stored: It is in the store; else every package has it.
        code: Digest of the code that the driver has.
        attempt: From 1.
        disk_bytes: Limit for all tasks of a machine; 0 = what the disk has.
    """

    operation: str
    url: str
    tags: Mapping[str, str]
    store: str
    settings: Mapping[str, Any]
    shown_settings: Mapping[str, Any]
    weights: str
    weights_digest: str
    weights_stored: bool
    code: str
    attempt: int = 1
    disk_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task.

    Args:
        key: Of its result.
        status: "done", or "exists" where the result had been there, or another attempt was quicker.
    """

    key: str
    status: Literal["done", "exists"]


@dataclass(frozen=True, slots=True)
class _File:
    """One file of a log: where, how large, and what tells its version."""

    url: str
    size: int
    version: str


def run_task(task: Task) -> Outcome:
    """Do a task, unless its result is there.

    Raises:
        StoreError: the store or the log cannot be reached.
        FleetError: this worker cannot do it (other code, too little disk).
        SemanticMapperError: the log, weights or settings cannot be used.
    """
    began = time.monotonic()
    if code_digest() != task.code:
        raise OtherCodeError(
            f"{socket.gethostname()}: this worker has other code ({code_version()}) than the driver, or other versions "
            "of torch, numpy, scipy, open3d or opencv; install the same everywhere"
        )
    store = open_store(task.store)
    files = _files_of(task.url)
    identity = _identity(files)
    source_name = f"sources/{_short(f'{task.url} {identity}')}.json"
    source = _read_source(store, source_name) if all(file.version for file in files) else None
    if source is not None:
        key = task_key(task, source.digest)
        if store.exists(f"results/{key}/result.json"):
            return Outcome(key, "exists")
    size = sum(file.size for file in files)
    local = not any("://" in file.url for file in files)
    with task_folder(OUTPUT_BYTES + (0 if local else size), task.disk_bytes) as folder:
        log, digest = _fetch(task.url, files, folder, local=local)
        store.write(source_name, msgspec.json.encode(Source(shown(task.url), identity, digest, size)))
        key = task_key(task, digest)
        if store.exists(f"results/{key}/result.json"):  # another URL of the same log, or another driver
            return Outcome(key, "exists")
        findings = _operate(task, store, log, folder / "out")
        if local and _identity(_files_of(task.url)) != identity:
            raise LogError(f"{shown(task.url)}: has changed while it was read; run it again once it is written")
        status = _make_result(task, store, key, digest, size, findings, folder / "out", began)
    return Outcome(key, status)


def _operate(task: Task, store: Store, log: Path, out: Path) -> Findings:
    """Do the operation; its files are in ``out`` then.

    Raises:
        DiskError: there was no room for them.
        SemanticMapperError: with what is wrong with the log, the weights or the settings.
    """
    from semantic_mapper.nodes.fleet.operations import OPERATIONS, Job, run_operation

    out.mkdir()
    settings = convert_config(task.settings, OPERATIONS[task.operation].settings, "settings of the fleet")
    try:
        return run_operation(task.operation, Job(log, out, _weights(task, store), settings))
    except (OSError, SemanticMapperError) as error:
        if _disk_is_full(error):
            raise DiskError(f"{socket.gethostname()}: the disk of {scratch_root()} is full ({error})") from error
        raise


def _disk_is_full(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__
    return False


def _make_result(
    task: Task, store: Store, key: str, digest: str, size: int, findings: Findings, out: Path, began: float
) -> Literal["done", "exists"]:
    """Put files and result into the store; after an error nothing of them stays."""
    attempt = f"results/{key}/{secrets.token_hex(6)}"
    files: dict[str, ResultFile] = {}
    try:
        for path in sorted(p for p in out.rglob("*") if p.is_file()):
            name = path.relative_to(out).as_posix()
            files[name] = ResultFile(path.stat().st_size, file_digest(path))
            store.take(path, f"{attempt}/{name}")
    except StoreError:
        store.remove(attempt, folder=True)
        raise
    result = TaskResult(
        key=key,
        operation=task.operation,
        log=shown(task.url),
        log_digest=digest,
        log_bytes=size,
        tags=dict(task.tags),
        weights=task.weights,
        weights_digest=task.weights_digest,
        settings=dict(task.shown_settings),
        version=code_version(),
        code=task.code,
        findings=findings,
        files=files,
        folder=attempt,
        attempts=task.attempt,
        seconds=round(time.monotonic() - began, 3),
        node=socket.gethostname(),
        finished_ns=time.time_ns(),
    )
    return "done" if store.commit(result) else "exists"


def task_key(task: Task, log_digest: str) -> str:
    """What a result is named by: everything that decides it, and nothing else."""
    decided = {
        "operation": task.operation,
        "log": log_digest,
        "weights": task.weights_digest,
        "settings": task.settings,
        "code": task.code,
    }
    return hashlib.sha256(msgspec.json.encode(decided, order="deterministic")).hexdigest()[:KEY_DIGITS]


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _files_of(url: str) -> list[_File]:
    """The files of a log: itself, or the parts in its folder.

    Raises:
        LogError: nothing is there.
        StoreError: it cannot be reached.
    """
    fs, path = split_url(url)
    try:
        info = persistently(lambda: fs.info(path), shown(url))
        if info.get("type") != "directory":
            return [_file(fs, info, path, url)]
        parts = persistently(lambda: fs.ls(path, detail=True), shown(url))
    except FileNotFoundError as error:
        raise LogError(f"{shown(url)}: no such log") from error
    named = sorted((p for p in parts if str(p["name"]).lower().endswith(".mcap")), key=lambda p: str(p["name"]))
    if not named:
        raise LogError(f"{shown(url)}: a folder without logs (.mcap)")
    return [_file(fs, part, str(part["name"]), url) for part in named]


def _file(fs: Any, info: Mapping[str, Any], path: str, url: str) -> _File:
    names = ("ETag", "etag", "md5Hash", "crc32c", "mtime", "LastModified", "updated")  # of s3, http, gs, file
    version = next((str(info[name]) for name in names if info.get(name)), "")
    size = info.get("size")
    return _File(unstripped(fs, path, url), int(size) if size is not None else 0, version)


def _read_source(store: Store, name: str) -> Source | None:
    for _, data in store.read_many([name]):
        try:
            return msgspec.json.decode(data, type=Source)
        except msgspec.DecodeError:  # it is only a short cut
            _log.warning("source_damaged", name=name)
    return None


def _fetch(url: str, files: list[_File], folder: Path, *, local: bool) -> tuple[Path, str]:
    """The log as a local file or folder, and the digest of its content."""
    if local:
        path = Path(split_url(url)[1])
        digests = [_checked_digest(file, Path(split_url(file.url)[1])) for file in files]
        return path, _joined(digests)
    target = folder / "log"
    target.mkdir()
    paths = [target / _file_name(file.url) for file in files]
    digests = [_download(file, path) for file, path in zip(files, paths, strict=True)]
    return target if len(paths) > 1 else paths[0], _joined(digests)


def _checked_digest(file: _File, path: Path) -> str:
    """SHA-256 of a file that was read; maps of another operation's results are those that it has made.

    Raises:
        StoreError: this one is not.
    """
    digest = file_digest(path)
    check_result_file(file.url, digest)
    return digest


def _file_name(url: str) -> str:
    """Without what signs a web address; in buckets "?" and "#" are letters."""
    return Path(urlsplit(url).path if url.startswith(("http://", "https://")) else url).name


def _identity(files: list[_File]) -> str:
    return ";".join(f"{file.size}:{file.version}" for file in files)


def _joined(digests: list[str]) -> str:
    """Of one file its own digest; of several, one over theirs in order."""
    return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _download(file: _File, target: Path) -> str:
    """Stream a file to the disk; its SHA-256. What a cut connection has lost is requested again, chunk by chunk."""
    fs, path = split_url(file.url)
    if "http" in fs.protocol:  # servers that know no ranges
        persistently(lambda: fs.get_file(path, str(target)), shown(file.url))
        return _checked_digest(file, target)
    digest = hashlib.sha256()
    with target.open("wb") as out:
        for start in range(0, file.size, CHUNK_BYTES):
            data = persistently(lambda: _chunk(fs, path, start, file.size), shown(file.url))  # noqa: B023
            digest.update(data)
            out.write(data)
    check_result_file(file.url, digest.hexdigest())
    return digest.hexdigest()


def _chunk(fs: Any, path: str, start: int, size: int) -> bytes:
    end = min(start + CHUNK_BYTES, size)
    data: bytes = fs.cat_file(path, start=start, end=end)
    if len(data) != end - start:  # the connection was cut, or the file has changed
        raise OSError(f"got {len(data)} of {end - start} bytes at {start}")
    return data


def stored_weights(digest: str, name: str) -> str:
    """Where a store keeps weights."""
    return f"weights/{digest}/{name}"


def _weights(task: Task, store: Store) -> Path | None:
    """The weights as a local file, fetched once a machine; a name of the package's own as it is.

    Raises:
        StoreError: they are not in the store, or damaged.
    """
    if not task.weights_stored:
        return Path(task.weights) if task.weights else None
    folder = scratch_root() / "weights" / task.weights_digest
    path = folder / task.weights
    if not path.exists():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        draft = folder / f"{secrets.token_hex(6)}.part"
        try:
            store.download(stored_weights(task.weights_digest, task.weights), draft)
            if file_digest(draft) != task.weights_digest:
                raise StoreError(f"{store.shown}: the weights {task.weights} in it are damaged; start the run again")
            os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)
        _remove_old(folder.parent, folder)
    return path


def _remove_old(folder: Path, kept: Path, count: int = 4) -> None:
    """All but the newest weights go: they can be fetched again."""
    others = sorted((p for p in folder.iterdir() if p != kept), key=lambda p: p.stat().st_mtime, reverse=True)
    for path in others[count - 1 :]:
        shutil.rmtree(path, ignore_errors=True)


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]
