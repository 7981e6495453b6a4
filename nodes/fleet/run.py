"""``fleet run``: one task for each log, scheduled and tried again by Ray; what is done is in the store alone.

So a run that was stopped or killed goes on with the same command, and nothing has to be repaired before.
"""

from __future__ import annotations

import hashlib
import os
import random
import secrets
import socket
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec

import semantic_mapper
from semantic_mapper.config import convert_config, to_plain
from semantic_mapper.errors import ConfigError, FleetError, LogError, StoreError, WeightsError
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint, shipped_checkpoint
from semantic_mapper.fields.nesf import SHIPPED, SMOOTHING, load_nesf
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.fleet.inputs import LogInput
from semantic_mapper.nodes.fleet.operations import OPERATIONS, Job, read_settings
from semantic_mapper.nodes.fleet.store import (
    Failure,
    Findings,
    ResultFile,
    Store,
    TaskResult,
    encode_document,
    file_digest,
)
from semantic_mapper.nodes.fleet.urls import MissingError, full_url, is_url, open_url, reaching, shown
from semantic_mapper.plain_text import without_secrets

MAX_RETRIES = 3  # of a task whose process died, whose node was lost, or that could not reach log or store
AHEAD = 2  # tasks handed to Ray for each that has room
MAX_ERROR = 2000  # letters
_KEY_DIGITS = 40
_PACKAGE = Path(semantic_mapper.__file__).parent
_SOURCES = (".py", ".c", ".h", ".jinja", ".js")
_COMPUTING = ("torch", "numpy", "scipy", "open3d", "opencv-contrib-python-headless")

_log = get_logger(__name__)


class OtherCodeError(FleetError):
    """A worker would not compute what the driver means."""


@dataclass(frozen=True, slots=True)
class Task:
    """One log and what to do with it; goes to a worker, which has nothing else.

    Args:
        operation: Of ``OPERATIONS``.
        store: URL of the store.
        settings: Plain data of the operation's kind.
        shown_settings: What was set, for people.
        weights: Their file's name, or the name of weights that ship with the package; empty = the default ones.
        weights_digest: SHA-256 of the file.
        weights_stored: It is in the store; else every package has it.
        code: Digest of the code that the driver has.
        log: What it is done with.
    """

    operation: str
    store: str
    settings: Mapping[str, Any]
    shown_settings: Mapping[str, Any]
    weights: str
    weights_digest: str
    weights_stored: bool
    code: str
    log: LogInput


@dataclass(frozen=True, slots=True)
class Resources:
    """What Ray reserves for a task: processors and GPUs, also fractions, and memory of its node."""

    cpus: float = 1.0
    gpus: float = 0.0
    memory_bytes: int = 2 << 30


@dataclass(slots=True)
class RunReport:
    """How far a run is: logs in all, done, that had a result already, and that failed."""

    total: int
    done: int = 0
    existing: int = 0
    failures: list[Failure] = field(default_factory=list[Failure])

    @property
    def over(self) -> int:
        """Logs that need nothing more."""
        return self.done + self.existing + len(self.failures)


# The driver


def make_template(
    operation: str,
    out: str,
    weights: str | None = None,
    assignments: Sequence[str] = (),
    config: Path | None = None,
) -> Task:
    """The task that all logs share. Weights from a file are put into the store, for workers elsewhere.

    Args:
        operation: Of ``OPERATIONS``.
        out: Path or URL of the store, which is made where nothing is.
        weights: File, URL, or name of weights that ship; None = the default ones.
        assignments, config: See ``read_settings``.

    Raises:
        ConfigError: a setting cannot be used, or no store can be there.
        WeightsError: the weights cannot.
        StoreError: they cannot be fetched or stored.
    """
    settings, given = read_settings(operation, assignments, config)
    store = Store(out, create=True)
    name, digest, stored = _find_weights(operation, store, weights)
    return Task(operation, store.url, to_plain(settings), given, name, digest, stored, code_digest(), LogInput(""))


def run_fleet(
    template: Task,
    inputs: Sequence[LogInput],
    resources: Resources,
    stopped: Callable[[], object] = bool,
    on_progress: Callable[[RunReport], None] = lambda report: None,
    function: Callable[[Task], bool] | None = None,
) -> RunReport:
    """Go through all logs, on the cluster that this process is connected with.

    Args:
        template: Of ``make_template``.
        inputs: The logs.
        resources: Of each task.
        stopped: Looked at often; once it is true, tasks that run are ended and the run is over.
        on_progress: Called after each log.
        function: What a worker does with a task; None = ``run_task``.

    Raises:
        FleetError: no node has the resources, or a worker has other code.
        StoreError: the store cannot be reached.
    """
    import ray

    if not _room(resources):  # Ray would wait for ever
        raise FleetError(
            f"no node of the cluster has {resources.cpus:g} CPUs, {resources.gpus:g} GPUs and "
            f"{resources.memory_bytes / 1e9:.3g} GB of memory for a task; ask for less (--cpus, --gpus, --memory) or "
            "join a larger cluster"
        )
    remote = ray.remote(function or run_task).options(
        num_cpus=resources.cpus,
        num_gpus=resources.gpus,
        memory=resources.memory_bytes,
        max_retries=MAX_RETRIES,
        retry_exceptions=[StoreError],
        scheduling_strategy="SPREAD",
        name=f"fleet {template.operation}",
    )
    store = Store(template.store)
    failed_before = {failure.key for failure in store.failures()}
    waiting = random.sample(inputs, len(inputs))  # two drivers that share a store seldom meet
    running: dict[Any, Task] = {}
    report = RunReport(len(inputs))
    while not stopped():
        room = _room(resources)  # nodes come and go
        while waiting and len(running) < room:
            task = replace(template, log=waiting.pop())
            running[remote.remote(task)] = task
        if not running and not waiting:
            return report
        if not running:
            time.sleep(0.2)
            continue
        ready, _ = ray.wait(list(running), num_returns=len(running), timeout=0.2)
        for reference in ready:
            task = running.pop(reference)
            error = _collect(report, reference)
            key = _digest(
                task.operation, task.log.url, task.weights_digest, msgspec.json.encode(task.settings).decode()
            )
            if error:
                _log.error("log_failed", log=shown(task.log.url), error=error)
                failure = Failure(
                    key=key,
                    operation=task.operation,
                    log=shown(task.log.url),
                    tags=task.log.tags,
                    version=code_version(),
                    error=error,
                    finished_ns=time.time_ns(),
                )
                store.write(f"failures/{key}.json", encode_document(failure))
                report.failures.append(failure)
            elif key in failed_before:
                store.remove(f"failures/{key}.json")
            on_progress(report)
    for reference in running:
        ray.cancel(reference, force=True)
    return report


def _collect(report: RunReport, reference: Any) -> str:
    """Count a task that has ended; what went wrong, or an empty text.

    Raises:
        OtherCodeError: every log would fail like that.
    """
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        done: Any = ray.get(reference)
    except RayTaskError as error:
        cause = error.cause
        if isinstance(cause, OtherCodeError):
            raise cause from error
        return _one_line(f"{type(cause).__name__}: {cause}")
    except RayError as error:  # the process died again and again, or its nodes did
        return _one_line(f"the process of the task died {MAX_RETRIES + 1} times: {type(error).__name__}: {error}")
    report.done += done
    report.existing += not done
    return ""


def _one_line(text: str) -> str:
    return without_secrets(" ".join(text.split()))[:MAX_ERROR]


def _room(resources: Resources) -> int:
    """How many tasks may be in Ray's hands; 0 = none fits on any node."""
    import ray

    needs = {"CPU": resources.cpus, "GPU": resources.gpus, "memory": resources.memory_bytes}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    fits = (min(int(node.get(name, 0.0) / need) for name, need in needs.items() if need) for node in nodes)
    return AHEAD * sum(fits)


def _find_weights(operation: str, store: Store, weights: str | None) -> tuple[str, str, bool]:
    """Name, digest, and whether they are in the store now."""
    refines = operation == "refine"
    if weights is None:
        default = shipped_checkpoint(SHIPPED) if refines else default_checkpoint_path()
        return "", "" if default is None else file_digest(default), False
    if refines and Path(weights) == SMOOTHING:
        return weights, weights, False
    shipped = shipped_checkpoint(Path(weights))
    if shipped is not None and not is_url(weights) and not Path(weights).is_file():
        return weights, file_digest(shipped), False
    fs, path = open_url(weights)
    name = Path(shown(weights)).name
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / name
        try:
            with reaching(weights):
                fs.get_file(path, str(local))
            (load_nesf if refines else load_checkpoint)(local)
        except WeightsError as error:
            raise WeightsError(str(error).replace(str(local), shown(weights))) from error
        digest = file_digest(local)
        store.upload(local, _stored_weights(digest, name))
    return name, digest, True


def _stored_weights(digest: str, name: str) -> str:
    return f"weights/{digest}/{name}"


# The worker


def run_task(task: Task) -> bool:
    """Do a task; False where its result was there, or another attempt was quicker.

    Raises:
        StoreError: the store or the log cannot be reached.
        OtherCodeError: this worker has other code.
        SemanticMapperError: the log, weights or settings cannot be used.
    """
    began = time.monotonic()
    if code_digest() != task.code:
        raise OtherCodeError(
            f"{socket.gethostname()}: this worker has other code ({code_version()}) than the driver, or other versions "
            f"of {', '.join(_COMPUTING)}; install the same everywhere"
        )
    try:
        store = Store(task.store)
    except ConfigError as error:
        raise StoreError(
            f"{socket.gethostname()}: {error}. Where nodes share no folder of this name, --out must be a bucket"
        ) from error
    versions = _versions(task.log.url)
    source = f"sources/{_digest(task.log.url, *versions.values())}"
    known = store.find(source) if all(versions.values()) else None  # the log was read before
    if known is not None and store.exists(f"results/{task_key(task, known.decode())}.json"):
        return False
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-fleet-") as folder:
        paths = [_local(url, Path(folder) / "log") for url in versions]
        digests = [file_digest(path) for path in paths]
        digest = digests[0] if len(digests) == 1 else _digest(*digests)
        store.write(source, digest.encode())
        key = task_key(task, digest)
        if store.exists(f"results/{key}.json"):  # another URL of the same log
            return False
        out = Path(folder) / "out"
        out.mkdir()
        operation = OPERATIONS[task.operation]
        settings = convert_config(task.settings, operation.settings, "settings of the fleet")
        log = paths[0] if len(paths) == 1 else paths[0].parent
        findings = operation.run(Job(log, out, _weights(task, store, Path(folder)), settings))
        if _versions(task.log.url) != versions:
            raise LogError(f"{shown(task.log.url)}: has changed while it was read; run it again once it is written")
        size = sum(path.stat().st_size for path in paths)
        return _commit(task, store, key, digest, size, findings, out, began)


def _commit(
    task: Task, store: Store, key: str, digest: str, size: int, findings: Findings, out: Path, began: float
) -> bool:
    """Put files and result into the store; after an error nothing of them stays."""
    folder = f"files/{key}/{secrets.token_hex(6)}"
    files: dict[str, ResultFile] = {}
    try:
        for path in sorted(p for p in out.rglob("*") if p.is_file()):
            name = path.relative_to(out).as_posix()
            files[name] = ResultFile(path.stat().st_size, file_digest(path))
            store.upload(path, f"{folder}/{name}")
    except StoreError:
        store.remove(folder)
        raise
    result = TaskResult(
        key=key,
        operation=task.operation,
        log=shown(task.log.url),
        log_digest=digest,
        log_bytes=size,
        tags=task.log.tags,
        weights=task.weights,
        settings=dict(task.shown_settings),
        version=code_version(),
        findings=findings,
        files=files,
        folder=folder,
        seconds=round(time.monotonic() - began, 3),
        node=socket.gethostname(),
        finished_ns=time.time_ns(),
    )
    return store.commit(result)


def task_key(task: Task, log_digest: str) -> str:
    """What a result is named by: everything that decides it, and nothing else."""
    settings = msgspec.json.encode(task.settings, order="deterministic").decode()
    return _digest(task.operation, log_digest, task.weights_digest, settings, task.code)


def _weights(task: Task, store: Store, folder: Path) -> Path | None:
    """The weights as a local file, or a name of the package's own.

    Raises:
        StoreError: they are not in the store, or damaged.
    """
    if not task.weights_stored:
        return Path(task.weights) if task.weights else None
    path = folder / task.weights
    store.download(_stored_weights(task.weights_digest, task.weights), path)
    if file_digest(path) != task.weights_digest:
        raise StoreError(f"{store.shown}: the weights {task.weights} in it are damaged; start the run again")
    return path


def _versions(url: str) -> dict[str, str]:
    """URLs of the files of a log: itself, or the parts in its folder; with size and version, empty where not known.

    Raises:
        LogError: nothing is there.
        StoreError: it cannot be reached.
    """
    fs, path = open_url(url)
    fs.invalidate_cache()
    try:
        with reaching(url):
            info = fs.info(path)
            is_folder = info["type"] == "directory"
            parts = fs.ls(path, detail=True) if is_folder else [{**info, "name": path}]
    except MissingError as error:
        raise LogError(f"{shown(url)}: no such log") from error
    if is_folder:
        parts = sorted((p for p in parts if p["name"].lower().endswith(".mcap")), key=lambda p: p["name"])
    if not parts:
        raise LogError(f"{shown(url)}: a folder without logs (.mcap)")
    names = ("ETag", "etag", "md5Hash", "crc32c", "mtime", "LastModified", "updated")  # of s3, http, gs, file
    versions = (next((f"{p.get('size')} {p[name]}" for name in names if p.get(name)), "") for p in parts)
    return dict(zip((full_url(fs, part["name"], url) for part in parts), versions, strict=True))


def _local(url: str, folder: Path) -> Path:
    """A file of a log on this machine, downloaded to a folder where it is elsewhere."""
    fs, path = open_url(url)
    if "file" in fs.protocol:
        return Path(path)
    # Without what signs a web address; in buckets "?" and "#" are letters.
    name = Path(urlsplit(url).path if url.startswith(("http://", "https://")) else url).name
    folder.mkdir(exist_ok=True)
    with reaching(url):
        fs.get_file(path, str(folder / name))
    return folder / name


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:_KEY_DIGITS]


# The code


@cache
def code_digest() -> str:
    """SHA-256 over the sources of the package, and the versions of the packages that compute."""
    digest = hashlib.sha256()
    for name in _COMPUTING:
        digest.update(f"{name} {metadata.version(name)}\n".encode())
    for folder, subfolders, files in os.walk(_PACKAGE, followlinks=True):  # drivers, nodes and replay are links
        subfolders[:] = sorted(s for s in subfolders if s not in ("__pycache__", "weights"))
        for name in sorted(files):
            if name.endswith(_SOURCES):
                path = Path(folder) / name
                digest.update(f"{path.relative_to(_PACKAGE)} {file_digest(path)}\n".encode())
    return digest.hexdigest()


def code_version() -> str:
    """Of the package, with the first digits of ``code_digest``, such as ``0.1.0+1a2b3c4d``."""
    return f"{semantic_mapper.__version__}+{code_digest()[:8]}"
