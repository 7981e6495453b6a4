"""``fleet run``: one task for each log, scheduled and tried again by Ray; what is done is in the store alone.

So a run that was stopped or killed goes on with the same command, and nothing has to be repaired before. A task is one
of the jobs of ``replay``, with its settings and its findings.
"""

import copy
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
from typing import Annotated, Any, Literal, TypeVar

import msgspec

import semantic_mapper
from semantic_mapper.config import (
    Config,
    DepthConfig,
    Fraction,
    MapperConfig,
    NotNegative,
    assign,
    check_quality,
    convert_config,
    parse_assignments,
    read_toml,
    to_plain,
)
from semantic_mapper.errors import ConfigError, FleetError, LogError, StoreError, WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.files import write_json
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.fleet.store import (
    Failure,
    Findings,
    LogInput,
    MethodScores,
    MissingError,
    Store,
    TaskResult,
    fetch,
    file_digest,
    full_url,
    open_url,
    reaching,
)
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.replay.autolabel import AutolabelRequest, autolabel_log
from semantic_mapper.replay.evaluate.report import write_eval_report
from semantic_mapper.replay.evaluate_log import evaluate_log
from semantic_mapper.replay.finetune_log import FinetuneRequest, finetune_log
from semantic_mapper.replay.map_log import OFFLINE, replay_log
from semantic_mapper.replay.run_folder import LOG_SUFFIX
from semantic_mapper.replay.summary import dig, notes
from semantic_mapper.training.config import FinetuneConfig

MAX_RETRIES = 3  # of a task whose process died, whose node was lost, or that could not reach log or store
_MAX_ERROR = 2000  # letters
_MAX_EVENTS = 200  # of one log
_SCORES = ("miou", "total_accuracy", "average_accuracy", "coverage")
_PACKAGE = Path(semantic_mapper.__file__).parent
_SOURCES = (".py", ".c", ".h", ".jinja", ".js", ".safetensors")
_COMPUTING = ("torch", "numpy", "scipy", "open3d", "cv2")  # modules: open3d may be of open3d-cpu
_VERSIONS = ("ETag", "etag", "md5Hash", "crc32c", "mtime", "LastModified", "updated")  # of s3, http, gs, file

_log = get_logger(__name__)

ConfigT = TypeVar("ConfigT", bound=Config)


@dataclass(frozen=True, slots=True)
class Task:
    """What to do with each log; goes to the workers, which have nothing else."""

    operation: str  # of ``OPERATIONS``
    store: str  # URL of the store
    settings: Mapping[str, Any]  # plain data of the operation's kind
    shown_settings: Mapping[str, Any]  # what was set, for people
    weights: str  # their file's name; empty = those that ship with the package
    weights_data: bytes  # content of their file; empty = they ship with the package
    code: str  # digest of the code that the driver has

    def key(self, log: str) -> str:
        """Digest of all that decides the result for a log, which is named by the digest of its content."""
        settings = msgspec.json.encode(self.settings, order="deterministic").decode()
        weights = hashlib.sha256(self.weights_data).hexdigest() if self.weights_data else self.weights
        return _digest(self.operation, log, weights, settings, self.code)


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
    operation: str, out: str, weights: str | None = None, assignments: Sequence[str] = (), config: Path | None = None
) -> Task:
    """What to do with each log.

    Raises ConfigError: a setting cannot be used (the nearest one is named), or no store can be there. WeightsError: the
    weights cannot. StoreError: they cannot be fetched.

    Args:
        operation: Of ``OPERATIONS``.
        out: Path or URL of the store, which is made where nothing is.
        weights: File or URL; None = those that ship with the package.
        assignments: As of ``--set``, such as ``max_frames=100``; they go before ``config``, a TOML file of such names.
    """
    found = OPERATIONS[operation]
    given = {} if config is None else read_toml(config)
    for name, value in parse_assignments(assignments, found.settings).items():
        assign(given, name, value, "--set")
    data = copy.deepcopy(given)
    for name, value in found.defaults.items():
        assign(data, name, value, "--set", replace=False)
    settings = convert_config(data, found.settings, "--set")
    if isinstance(settings, MapperConfig):
        check_quality(given, settings.quality, "--set")
    name, content = ("", b"") if weights is None else _read_weights(weights)
    store = Store(out, create=True)
    return Task(operation, store.url, to_plain(settings), given, name, content, code_digest())


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

    Raises FleetError: no node has the resources, or a worker has other code. StoreError: the store cannot be reached.

    Args:
        cpus, gpus, memory_gb: What Ray reserves for a task.
        stopped: Looked at often; once it is true, tasks that run are ended and the run is over.
        on_progress: Called after each log.
        function: What a worker does with a log; None = ``run_task``.
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
            log = running.pop(reference)
            key, error = task.key(log.url), _count(reference, report)
            if error:
                error = without_secrets(" ".join(error.split()))[:_MAX_ERROR]
                shown = without_secrets(log.url)
                about = {"operation": task.operation, "tags": log.tags, "version": code_version()}
                failure = Failure(key=key, log=shown, error=error, finished_ns=time.time_ns(), **about)
                _log.error("log_failed", log=shown, error=error)
                store.note_failure(failure)
                report.failures.append(failure)
            elif f"{key}.json" in failed_before:
                store.remove(f"failures/{key}.json")
            on_progress(report)
    for reference in running:
        ray.cancel(reference, force=True)
    return report


def _count(reference: Any, report: RunReport) -> str:
    """Count a task that has ended; what went wrong, or an empty text. A ``FleetError`` is that of every log."""
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


def _read_weights(weights: str) -> tuple[str, bytes]:
    with tempfile.TemporaryDirectory() as folder, reaching(weights):
        local = fetch(weights, Path(folder) / _name_of(weights))
        data = local.read_bytes()
        try:
            load_checkpoint(local)
        except WeightsError as error:
            raise WeightsError(str(error).replace(str(local), without_secrets(weights))) from error
    return local.name, data


# The worker


def run_task(task: Task, log: LogInput) -> bool:
    """Do a task with a log; False where its result was there, or another attempt was quicker.

    Raises StoreError: the store or the log cannot be reached. FleetError: this worker has other code.
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
        raise StoreError(f"{socket.gethostname()}: {error}. Without a shared folder --out must be a bucket") from error
    versions = _versions(log.url)
    source = f"sources/{_digest(log.url, *versions.values())}"
    known = store.find(source) if all(versions.values()) else None  # the log was read before
    if known is not None and store.find(f"results/{task.key(known.decode())}.json") is not None:
        return False
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-fleet-") as name:
        folder = Path(name)
        paths = [fetch(url, folder / "log" / _name_of(url)) for url in versions]
        digests = [file_digest(path) for path in paths]
        digest = digests[0] if len(digests) == 1 else _digest(*digests)
        store.write(source, digest.encode())
        key = task.key(digest)
        if store.find(f"results/{key}.json") is not None:  # another URL of the same log
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
            raise LogError(f"{without_secrets(log.url)}: changed while it was read; run it again once it is written")
        place = f"files/{key}/{secrets.token_hex(6)}"
        result = TaskResult(
            key=key,
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
    files = {path.relative_to(out).as_posix(): path for path in sorted(out.rglob("*")) if path.is_file()}
    try:
        for name, path in files.items():
            store.upload(path, f"{place}/{name}")
    except StoreError:
        store.remove(place)
        raise
    return {name: file_digest(path) for name, path in files.items()}


def _versions(url: str) -> dict[str, str]:
    """URLs of the files of a log: itself, or the parts in its folder; with size and version, empty where not known."""
    fs, path = open_url(url)
    fs.invalidate_cache()
    try:
        with reaching(url):
            info = fs.info(path)
            parts = fs.ls(path, detail=True) if info["type"] == "directory" else [{**info, "name": path}]
    except MissingError as error:
        raise LogError(f"{without_secrets(url)}: no such log") from error
    if info["type"] == "directory":
        parts = sorted((p for p in parts if p["name"].lower().endswith(LOG_SUFFIX)), key=lambda p: p["name"])
    if not parts:
        raise LogError(f"{without_secrets(url)}: a folder without logs ({LOG_SUFFIX})")
    versions = (next((f"{p.get('size')} {p[name]}" for name in _VERSIONS if p.get(name)), "") for p in parts)
    return dict(zip((full_url(fs, part["name"], url) for part in parts), versions, strict=True))


def _name_of(url: str) -> str:
    """Of a file, without what signs a web address."""
    return Path(url.split("?", 1)[0]).name


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:40]


@cache
def code_digest() -> str:
    """SHA-256 over sources and weights of the package, and the versions of the packages that compute."""
    digest, packages = hashlib.sha256(), metadata.packages_distributions()
    for name in _COMPUTING:
        digest.update(f"{name} {[metadata.version(package) for package in packages.get(name, ())[:1]]}\n".encode())
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


# The operations


class LogSettings(MapperConfig, frozen=True):
    """Of ``map`` and ``eval``: those of the mapper, and ``max_frames`` (0 = all)."""

    max_frames: NotNegative = 0


class AutolabelSettings(LogSettings, frozen=True):
    """Of ``autolabel``."""

    write_depth: bool = False
    min_confidence: Fraction = 0.0
    overwrite_labels: bool = False


class FinetuneSettings(FinetuneConfig, frozen=True):
    """Of ``finetune``: those of finetuning, and which field learns from what."""

    keyframes: Annotated[int, msgspec.Meta(ge=2)] = 8
    # Of a field of one scene; empty = finetune the weights. No "panoptic", which needs boxes of each log.
    kind: Literal["", "irt", "grid"] = ""


@dataclass(frozen=True, slots=True)
class Operation:
    """One of ``OPERATIONS``."""

    settings: type[Config]  # kind of its settings
    # does it: log, empty folder for files of the result, weights (None = those that ship), settings
    run: Callable[[Path, Path, Path | None, Any], Findings]
    memory_gb: float = 2.0  # a task is given at least so much, unless the user says otherwise
    defaults: Mapping[str, Any] = field(default_factory=dict[str, Any])  # settings that differ from those of the kind


def _map(log: Path, out: Path, weights: Path | None, settings: LogSettings) -> Findings:
    summary, _ = replay_log(log, out, weights, _part(settings, MapperConfig), settings.max_frames)
    metrics = {name: dig(summary, f"metrics.{name}") for name in (*_SCORES, "map_miou")}
    metrics |= {f"frames_{name}": count for name, count in summary["frames"].items()}
    metrics |= {name: summary["map"][name] for name in ("surface_points", "blocks", "cleared_voxels", "unknown")}
    metrics["depth_disagreement"] = dig(summary, "pose_check.worst_depth_disagreement")
    costs = {f"step_ms_{name}": value for name, value in summary["latency_ms"].items()}
    events = [("note", text) for text in notes(summary)]
    events += [("damaged", text) for text in summary["damaged_stretches"]]
    events += [("refused", f"frame {r['seq']}: {r['reason']}") for r in summary["refusals"]]
    costs["map_memory_mb"] = summary["map"]["memory_mb"]
    scores = MethodScores("map", dig(summary, "metrics.per_class") or {})
    return Findings(metrics=metrics, costs=costs, scores=(scores,), events=tuple(events[:_MAX_EVENTS]))


def _eval(log: Path, out: Path, weights: Path | None, settings: LogSettings) -> Findings:
    result = evaluate_log(log, weights, _part(settings, MapperConfig), settings.max_frames)
    scores = result.plain()
    found: dict[str, Any] = {"replays": {}, "logs": {log.name: scores}}
    write_json(out / "eval.json", found)
    write_eval_report(out / "eval.html", found)
    methods: Mapping[str, Mapping[str, Any]] = scores["methods"]
    main = next(iter(methods.values()))
    metrics = {key: main.get(key) for key in (*_SCORES, "ece")}
    metrics |= {f"miou {method}": figures.get("miou") for method, figures in methods.items()}
    metrics |= {f"frames_{key}": scores[key] for key in ("scored", "excluded", "refused", "damaged", "pseudo_labelled")}
    scored = (MethodScores(method, figures["per_class"]) for method, figures in methods.items())
    return Findings(metrics=metrics, scores=tuple(scored))


def _autolabel(log: Path, out: Path, weights: Path | None, settings: AutolabelSettings) -> Findings:
    which = (settings.write_depth, settings.min_confidence, settings.overwrite_labels, settings.max_frames)
    config = _part(settings, MapperConfig)
    report = autolabel_log(AutolabelRequest((log,), out / "labelled.mcap", weights, config, *which))
    figures = ("frames", "labelled", "kept", "replaced", "unlabelled", "depth_written", "mean_confidence")
    events = [("unlabelled", text) for text in report.unlabelled]
    events += [("damaged", text) for text in report.damage]
    metrics = {name: getattr(report.note, name) for name in (*figures, "labelled_pixels")}
    return Findings(metrics=metrics, events=tuple(events[:_MAX_EVENTS]))


def _finetune(log: Path, out: Path, weights: Path | None, settings: FinetuneSettings) -> Findings:
    request = FinetuneRequest(
        log,
        out / "weights.safetensors",
        0 if settings.kind == "grid" else settings.keyframes,  # a grid learns no classes
        _part(settings, FinetuneConfig),
        None if settings.kind else weights,
        depth=DepthConfig(source="sensor"),
        kind=settings.kind or None,
    )
    checkpoint, chosen = finetune_log(request)
    recipe = checkpoint.recipe
    names = ("steps", "best_step", "held_out_loss", "held_out_accuracy", "psnr")
    metrics = {name: recipe[name] for name in names if name in recipe}
    events = (("keyframes", ", ".join(map(str, chosen))),)
    return Findings(metrics=metrics, costs={"fit_s": recipe.get("seconds")}, events=events)


OPERATIONS: Mapping[str, Operation] = {
    "map": Operation(LogSettings, _map, defaults=OFFLINE),
    "eval": Operation(LogSettings, _eval),
    "autolabel": Operation(AutolabelSettings, _autolabel, defaults=OFFLINE),
    "finetune": Operation(FinetuneSettings, _finetune, memory_gb=4.0),
}


def _part(settings: Config, kind: type[ConfigT]) -> ConfigT:
    """Those settings that a job's own config has."""
    return kind(**{name: getattr(settings, name) for name in kind.__struct_fields__})
