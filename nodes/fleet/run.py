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
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

import semantic_mapper
from semantic_mapper.config import convert_config, to_plain
from semantic_mapper.errors import ConfigError, FleetError, LogError, StoreError, WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint, shipped_checkpoint
from semantic_mapper.fields.nesf import SMOOTHING, load_nesf
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.fleet.operations import OPERATIONS, read_settings
from semantic_mapper.nodes.fleet.store import Failure, Store, TaskResult, file_digest
from semantic_mapper.nodes.fleet.urls import LogInput, MissingError, full_url, is_url, open_url, reaching
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.replay.run_folder import LOG_SUFFIX

MAX_RETRIES = 3  # of a task whose process died, whose node was lost, or that could not reach log or store
_MAX_ERROR = 2000  # letters
_PACKAGE = Path(semantic_mapper.__file__).parent
_SOURCES = (".py", ".c", ".h", ".jinja", ".js", ".safetensors")
_COMPUTING = ("torch", "numpy", "scipy", "open3d", "opencv-contrib-python-headless")
_VERSIONS = ("ETag", "etag", "md5Hash", "crc32c", "mtime", "LastModified", "updated")  # of s3, http, gs, file

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Task:
    """What to do with each log; goes to the workers, which have nothing else."""

    operation: str  # of ``OPERATIONS``
    store: str  # URL of the store
    settings: Mapping[str, Any]  # plain data of the operation's kind
    shown_settings: Mapping[str, Any]  # what was set, for people
    weights: str  # their file's name, or the name of weights that ship with the package; empty = the default ones
    weights_data: bytes  # content of their file; empty = they ship with the package
    weights_digest: str  # SHA-256 of it
    code: str  # digest of the code that the driver has

    def key(self, log: str) -> str:
        """Digest of all that decides the result for a log, which is named by the digest of its content."""
        settings = msgspec.json.encode(self.settings, order="deterministic").decode()
        return _digest(self.operation, log, self.weights_digest or self.weights, settings, self.code)


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


def make_task(
    operation: str,
    out: str,
    weights: str | None = None,
    assignments: Sequence[str] = (),
    config: Path | None = None,
) -> Task:
    """What to do with each log.

    Args:
        operation: Of ``OPERATIONS``.
        out: Path or URL of the store, which is made where nothing is.
        weights: File, URL, or name of weights that ship; None = the default ones.
        assignments, config: See ``read_settings``.

    Raises:
        ConfigError: a setting cannot be used, or no store can be there.
        WeightsError: the weights cannot.
        StoreError: they cannot be fetched.
    """
    settings, given = read_settings(operation, assignments, config)
    store = Store(out, create=True)
    name, data = ("", b"") if weights is None else _read_weights(operation, weights)
    digest = hashlib.sha256(data).hexdigest() if data else ""
    return Task(operation, store.url, to_plain(settings), given, name, data, digest, code_digest())


def run_fleet(
    task: Task,
    inputs: Sequence[LogInput],
    *,
    cpus: float = 1.0,
    gpus: float = 0.0,
    memory_gb: float = 2.0,
    stopped: Callable[[], object] = bool,
    on_progress: Callable[[RunReport], object] = lambda report: None,
    function: Callable[[Task, LogInput], bool] | None = None,
) -> RunReport:
    """Go through all logs, on the cluster that this process is connected with.

    Args:
        task: What to do with each log.
        inputs: The logs.
        cpus, gpus, memory_gb: What Ray reserves for a task.
        stopped: Looked at often; once it is true, tasks that run are ended and the run is over.
        on_progress: Called after each log.
        function: What a worker does with a log; None = ``run_task``.

    Raises:
        FleetError: no node has the resources, or a worker has other code.
        StoreError: the store cannot be reached.
    """
    import ray

    needs = {"CPU": cpus, "GPU": gpus, "memory": memory_gb * 1e9}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(name, 0.0) >= need for name, need in needs.items()) for node in nodes):
        raise FleetError(  # Ray would wait for ever
            f"no node of the cluster has {cpus:g} CPUs, {gpus:g} GPUs and {memory_gb:.3g} GB of memory for a task; ask "
            "for less (--cpus, --gpus, --memory) or join a larger cluster"
        )
    remote = ray.remote(function or run_task).options(
        num_cpus=cpus,
        num_gpus=gpus,
        memory=round(memory_gb * 1e9),
        max_retries=MAX_RETRIES,
        retry_exceptions=[StoreError],
        scheduling_strategy="SPREAD",
        name=f"fleet {task.operation}",
    )
    store = Store(task.store)
    failed_before = set(store.names("failures"))
    shared = ray.put(task)
    shuffled = random.sample(inputs, len(inputs))  # two drivers that share a store seldom meet
    running: dict[Any, LogInput] = {remote.remote(shared, log): log for log in shuffled}
    report = RunReport(len(inputs))
    while running and not stopped():
        ready, _ = ray.wait(list(running), num_returns=len(running), timeout=0.2)
        for reference in ready:
            key, error = task.key(running[reference].url), _count(reference, report)
            if error:
                report.failures.append(_note_failure(store, task, key, running[reference], error))
            elif f"{key}.json" in failed_before:
                store.remove(f"failures/{key}.json")
            del running[reference]
            on_progress(report)
    for reference in running:
        ray.cancel(reference, force=True)
    return report


def _count(reference: Any, report: RunReport) -> str:
    """Count a task that has ended; what went wrong, or an empty text.

    Raises:
        FleetError: every log would fail like that.
    """
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        done: Any = ray.get(reference)
    except RayTaskError as error:
        if isinstance(error.cause, FleetError):
            raise error.cause from error
        return f"{type(error.cause).__name__}: {error.cause}"
    except RayError as error:  # the process died again and again, or its nodes did
        return f"the process of the task died {MAX_RETRIES + 1} times: {type(error).__name__}: {error}"
    report.done += done
    report.existing += not done
    return ""


def _note_failure(store: Store, task: Task, key: str, log: LogInput, error: str) -> Failure:
    failure = Failure(
        key=key,
        operation=task.operation,
        log=without_secrets(log.url),
        tags=log.tags,
        version=code_version(),
        error=without_secrets(" ".join(error.split()))[:_MAX_ERROR],
        finished_ns=time.time_ns(),
    )
    _log.error("log_failed", log=failure.log, error=failure.error)
    store.note_failure(failure)
    return failure


def _read_weights(operation: str, weights: str) -> tuple[str, bytes]:
    """Name and content; no content for weights that ship."""
    refines = operation == "refine"
    is_file = is_url(weights) or Path(weights).is_file()
    if not is_file and ((refines and Path(weights) == SMOOTHING) or shipped_checkpoint(Path(weights)) is not None):
        return weights, b""
    fs, path = open_url(weights)
    with reaching(weights):
        data = fs.cat_file(path)
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / _name_of(path)
        local.write_bytes(data)
        try:
            (load_nesf if refines else load_checkpoint)(local)
        except WeightsError as error:
            raise WeightsError(str(error).replace(str(local), without_secrets(weights))) from error
    return local.name, data


# The worker


def run_task(task: Task, log: LogInput) -> bool:
    """Do a task with a log; False where its result was there, or another attempt was quicker.

    Raises:
        StoreError: the store or the log cannot be reached.
        FleetError: this worker has other code.
        SemanticMapperError: the log, weights or settings cannot be used.
    """
    began = time.monotonic()
    if code_digest() != task.code:
        raise FleetError(
            f"{socket.gethostname()}: this worker has other code ({code_version()}) than the driver, or other versions "
            f"of {', '.join(_COMPUTING)}; install the same everywhere"
        )
    try:
        store = Store(task.store)
    except ConfigError as error:
        raise StoreError(
            f"{socket.gethostname()}: {error}. Where nodes share no folder of this name, --out must be a bucket"
        ) from error
    versions = _versions(log.url)
    source = f"sources/{_digest(log.url, *versions.values())}"
    known = store.find(source) if all(versions.values()) else None  # the log was read before
    if known is not None and store.exists(f"results/{task.key(known.decode())}.json"):
        return False
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-fleet-") as name:
        folder = Path(name)
        paths = [_local(url, folder / "log") for url in versions]
        digests = [file_digest(path) for path in paths]
        digest = digests[0] if len(digests) == 1 else _digest(*digests)
        store.write(source, digest.encode())
        if store.exists(f"results/{task.key(digest)}.json"):  # another URL of the same log
            return False
        out = folder / "out"
        out.mkdir()
        operation = OPERATIONS[task.operation]
        settings = convert_config(task.settings, operation.settings, "settings of the fleet")
        weights = Path(task.weights) if task.weights else None
        if task.weights_data:
            weights = folder / task.weights
            weights.write_bytes(task.weights_data)
        findings = operation.run(paths[0] if len(paths) == 1 else paths[0].parent, out, weights, settings)
        if _versions(log.url) != versions:
            raise LogError(
                f"{without_secrets(log.url)}: has changed while it was read; run it again once it is written"
            )
        place = f"files/{task.key(digest)}/{secrets.token_hex(6)}"
        result = TaskResult(
            key=task.key(digest),
            operation=task.operation,
            log=without_secrets(log.url),
            log_digest=digest,
            tags=log.tags,
            weights=task.weights,
            settings=dict(task.shown_settings),
            version=code_version(),
            findings=findings,
            files=_upload(store, out, place),
            folder=place,
            seconds=round(time.monotonic() - began, 3),
            node=socket.gethostname(),
            finished_ns=time.time_ns(),
        )
        return store.commit(result)


def _upload(store: Store, out: Path, place: str) -> dict[str, str]:
    """Put files of a result into the store, their digests by name; after an error nothing of them stays."""
    files: dict[str, str] = {}
    try:
        for path in sorted(p for p in out.rglob("*") if p.is_file()):
            name = path.relative_to(out).as_posix()
            files[name] = file_digest(path)
            store.upload(path, f"{place}/{name}")
    except StoreError:
        store.remove(place)
        raise
    return files


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
        raise LogError(f"{without_secrets(url)}: no such log") from error
    if is_folder:
        parts = sorted((p for p in parts if p["name"].lower().endswith(LOG_SUFFIX)), key=lambda p: p["name"])
    if not parts:
        raise LogError(f"{without_secrets(url)}: a folder without logs ({LOG_SUFFIX})")
    versions = (next((f"{p.get('size')} {p[name]}" for name in _VERSIONS if p.get(name)), "") for p in parts)
    return dict(zip((full_url(fs, part["name"], url) for part in parts), versions, strict=True))


def _local(url: str, folder: Path) -> Path:
    """A file of a log on this machine, downloaded to a folder where it is elsewhere."""
    fs, path = open_url(url)
    if "file" in fs.protocol:
        return Path(path)
    folder.mkdir(exist_ok=True)
    with reaching(url):
        fs.get_file(path, str(folder / _name_of(path)))
    return folder / _name_of(path)


def _name_of(path: str) -> str:
    """Of a file, without what signs a web address."""
    return Path(path.split("?", 1)[0]).name


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:40]


# The code


@cache
def code_digest() -> str:
    """SHA-256 over sources and weights of the package, and the versions of the packages that compute."""
    digest = hashlib.sha256()
    for name in _COMPUTING:
        digest.update(f"{name} {metadata.version(name)}\n".encode())
    for folder, subfolders, files in os.walk(_PACKAGE, followlinks=True):  # drivers, nodes and replay are links
        subfolders[:] = sorted(s for s in subfolders if s != "__pycache__")
        for name in sorted(files):
            if name.endswith(_SOURCES):
                path = Path(folder) / name
                digest.update(f"{path.relative_to(_PACKAGE)} {file_digest(path)}\n".encode())
    return digest.hexdigest()


def code_version() -> str:
    """Of the package, with the first digits of ``code_digest``, such as ``0.1.0+1a2b3c4d``."""
    return f"{semantic_mapper.__version__}+{code_digest()[:8]}"
