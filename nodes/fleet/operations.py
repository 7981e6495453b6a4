"""What a fleet can do with one log: the verbs of the command line, each with its settings and its findings."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np

from semantic_mapper.config import (
    Config,
    Fraction,
    MapperConfig,
    NotNegative,
    assign,
    check_quality,
    convert_config,
    read_toml,
    to_plain,
)
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.segments import Segments
from semantic_mapper.nodes.fleet.results import ClassRow, EventRow, Findings, SegmentRow
from semantic_mapper.training.config import FinetuneConfig

if TYPE_CHECKING:
    from semantic_mapper.replay.session import MapSession

LOG_SUFFIX, MAP_SUFFIX = ".mcap", ".npz"
THUMBNAIL = "thumbnail.jpg"
THUMBNAIL_WIDTH = 480  # pixels
DEFAULT_KEYFRAMES = 8
MAX_EVENTS = 200  # of one log

_MAPPER, _FIT = "mapper", "fit"  # what settings of another name than an operation's own belong to


class ReplaySettings(Config, frozen=True):
    """Of ``replay``: its own, and those of the mapper."""

    max_frames: NotNegative = 0  # 0 = all
    mapper: MapperConfig = MapperConfig()


class EvalSettings(Config, frozen=True):
    """Of ``eval``."""

    max_frames: NotNegative = 0  # 0 = all
    mapper: MapperConfig = MapperConfig()


class AutolabelSettings(Config, frozen=True):
    """Of ``autolabel``."""

    max_frames: NotNegative = 0  # 0 = all
    depth: bool = False
    min_confidence: Fraction = 0.0
    overwrite_labels: bool = False
    mapper: MapperConfig = MapperConfig()


class FinetuneSettings(Config, frozen=True):
    """Of ``finetune``."""

    keyframes: Annotated[int, msgspec.Meta(ge=2)] = DEFAULT_KEYFRAMES
    # Of a field of one scene; empty = finetune the weights. No "panoptic", which needs boxes of each log.
    kind: Literal["", "irt", "grid"] = ""
    fit: FinetuneConfig = FinetuneConfig()


class RefineSettings(Config, frozen=True):
    """Of ``refine``."""

    fill: Fraction = 0.5
    up: str = "auto"
    by_name: bool = False


@dataclass(frozen=True, slots=True)
class Job:
    """One log in the hands of a worker.

    Args:
        log: The log, a folder with the parts of one, or a map.
        out: Empty folder; what is in it at the end belongs to the result.
        weights: None = what ships with the package for this operation.
        settings: Of the operation's kind.
    """

    log: Path
    out: Path
    weights: Path | None
    settings: Any


@dataclass(frozen=True, slots=True)
class Operation:
    """One of ``OPERATIONS``.

    Args:
        settings: Kind of its settings.
        rest: The field of ``settings`` that takes all other names; empty = none.
        run: Does it.
        memory_gb: A task is given at least so much, unless the user says otherwise.
        suffix: Of the files that it takes.
    """

    settings: type[Config]
    rest: str
    run: Callable[[Job], Findings]
    memory_gb: float
    suffix: str = LOG_SUFFIX


def read_settings(operation: str, assignments: Sequence[str], config: Path | None = None) -> Config:
    """Settings of an operation with what ``--set NAME=VALUE`` says; values as in TOML, bare words are text.

    Names are the operation's own (``max_frames``), or the mapper's (``quality``, ``voxel_map.voxel_size_m``), or for
    ``finetune`` those of its config (``seconds``).

    Args:
        operation: Of ``OPERATIONS``.
        assignments: What ``--set`` says.
        config: TOML file with the same names; ``--set`` goes before it.

    Raises:
        ConfigError: no such setting, with the nearest one; or a value that it cannot have.
    """
    kind, rest = OPERATIONS[operation].settings, OPERATIONS[operation].rest
    own = {field.encode_name for field in msgspec.structs.fields(kind)}
    table = {} if config is None else read_toml(config)
    plain: dict[str, Any] = {name: value for name, value in table.items() if name in own}
    if others := {name: value for name, value in table.items() if name not in own}:
        plain = {**plain, rest: others} if rest else {**plain, **others}
    for text in assignments:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigError(f"--set {text}: write NAME=VALUE, such as max_frames=100")
        path = name.split(".")
        if path[0] not in own:
            _check_known(operation, path[0], name)
            path = [rest, *path]
        _assign(plain, path, _value(value), name)
    settings = convert_config(plain, kind, "--set")
    if rest == _MAPPER:
        check_quality(plain.get(_MAPPER, {}), settings.mapper.quality, "--set")  # pyright: ignore[reportAttributeAccessIssue]
    return settings


def _check_known(operation: str, first: str, name: str) -> None:
    """Refuse a setting that neither the operation nor what its other settings belong to has."""
    kind, rest = OPERATIONS[operation].settings, OPERATIONS[operation].rest
    fields = {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
    names = [own for own in fields if own != rest]
    if rest:
        inner: type[Config] = fields[rest]
        names += [field.encode_name for field in msgspec.structs.fields(inner)]
    if first not in names:
        near = difflib.get_close_matches(first, names, n=1, cutoff=0.5)
        mend = f"did you mean `{near[0]}`?" if near else f"there is {', '.join(names)}"
        raise ConfigError(f"--set {name}: `{operation}` has no such setting; {mend}")


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _assign(plain: dict[str, Any], path: Sequence[str], value: Any, name: str) -> None:
    table = plain
    for key in path[:-1]:
        table = table.setdefault(key, {})
        if not isinstance(table, dict):
            raise ConfigError(f"--set {name}: is set both as a value and as a table")
    table[path[-1]] = value


def changed_settings(settings: Config) -> dict[str, Any]:
    """What differs from the defaults, by dotted names as ``--set`` takes them, for people and tables."""
    changes = _changes(to_plain(settings), to_plain(type(settings)()), "")
    return {name.removeprefix(f"{_MAPPER}.").removeprefix(f"{_FIT}."): value for name, value in changes}


def _changes(plain: Mapping[str, Any], default: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in plain.items():
        if isinstance(value, Mapping) and isinstance(default.get(name), Mapping):
            found += _changes(value, default[name], f"{prefix}{name}.")
        elif value != default.get(name):
            found.append((prefix + name, value))
    return found


def run_operation(operation: str, job: Job) -> Findings:
    """Do it.

    Raises:
        SemanticMapperError: with what is wrong with the log, the weights or the settings.
    """
    return OPERATIONS[operation].run(job)


def _replay(job: Job) -> Findings:
    from semantic_mapper.replay.artifacts import REPORT_NAME
    from semantic_mapper.replay.jobs import ReplayRequest, replay_log
    from semantic_mapper.replay.summary import dig

    settings: ReplaySettings = job.settings
    config = _with_delay(settings.mapper)
    request = ReplayRequest(job.log, job.out, job.weights, config, settings.max_frames)
    result = replay_log(request)
    summary, session = result.summary, result.session
    metrics = {name: _number(dig(summary, f"metrics.{name}")) for name in _SCORES}
    metrics |= {f"frames_{name}": _number(count) for name, count in summary["frames"].items()}
    for name in ("surface_points", "blocks", "cleared_voxels", "unknown"):
        metrics[name] = _number(summary["map"][name])
    metrics["depth_disagreement"] = _number(dig(summary, "pose_check.worst_depth_disagreement"))
    costs = {f"step_ms_{name}": _number(value) for name, value in summary["latency_ms"].items()}
    costs["map_memory_mb"] = _number(summary["map"]["memory_mb"])
    classes = [ClassRow("replay", name, iou) for name, iou in (dig(summary, "metrics.per_class") or {}).items()]
    return Findings(
        metrics=metrics,
        costs=costs,
        classes=tuple(classes),
        events=_events(summary),
        segments=tuple(_segments("replay", session.segments)),
        thumbnail=_write_thumbnail(session, job.out),
        report=REPORT_NAME,
    )


_SCORES = ("miou", "total_accuracy", "average_accuracy", "coverage", "map_miou")


def _eval(job: Job) -> Findings:
    from semantic_mapper.files import write_json
    from semantic_mapper.replay.evaluate.report import score_table, write_eval_report
    from semantic_mapper.replay.jobs import EvaluateRequest, evaluate_log

    settings: EvalSettings = job.settings
    result = evaluate_log(EvaluateRequest(job.log, job.weights, settings.mapper, settings.max_frames))
    scores, evaluation = result.scores, result.evaluation
    name = job.log.name
    found: dict[str, Any] = {"replays": {}, "logs": {name: scores}}
    write_json(job.out / "eval.json", found)
    write_eval_report(job.out / "eval.html", {}, [], {name: score_table(name, scores)}, found)
    methods: Mapping[str, Mapping[str, Any]] = scores["methods"]
    main = next(iter(methods.values()))
    metrics = {key: _number(main.get(key)) for key in ("miou", "total_accuracy", "average_accuracy", "coverage", "ece")}
    for method, figures in methods.items():
        metrics[f"miou {method}"] = _number(figures.get("miou"))
    for key in ("scored", "excluded", "refused", "damaged", "pseudo_labelled"):
        metrics[f"frames_{key}"] = _number(scores[key])
    classes = [ClassRow(m, c, iou) for m, figures in methods.items() for c, iou in figures["per_class"].items()]
    segments = [row for method, found in evaluation.segments.items() for row in _segments(method, found)]
    events = tuple(EventRow("note", note) for note in scores["notes"])
    return Findings(
        metrics=metrics, classes=tuple(classes), events=events, segments=tuple(segments), report="eval.html"
    )


def _autolabel(job: Job) -> Findings:
    from semantic_mapper.replay.jobs import AutolabelRequest, autolabel_log

    settings: AutolabelSettings = job.settings
    request = AutolabelRequest(
        (job.log,),
        job.out / "labelled.mcap",
        job.weights,
        _with_delay(settings.mapper),
        settings.depth,
        settings.min_confidence,
        settings.overwrite_labels,
        settings.max_frames,
    )
    report = autolabel_log(request)
    note = report.note
    names = (
        "frames",
        "labelled",
        "kept",
        "replaced",
        "unlabelled",
        "depth_written",
        "mean_confidence",
        "labelled_pixels",
    )
    events = [EventRow("unlabelled", text) for text in report.unlabelled]
    events += [EventRow("damaged", text) for text in report.damage]
    return Findings(metrics={name: _number(getattr(note, name)) for name in names}, events=tuple(events[:MAX_EVENTS]))


def _finetune(job: Job) -> Findings:
    from semantic_mapper.replay.jobs import FinetuneRequest, finetune_log

    settings: FinetuneSettings = job.settings
    request = FinetuneRequest(
        job.log,
        job.out / "weights.safetensors",
        keyframes=0 if settings.kind == "grid" else settings.keyframes,  # a grid learns no classes
        config=settings.fit,
        weights=None if settings.kind else job.weights,
        kind=settings.kind or None,
    )
    result = finetune_log(request)
    recipe, chosen = result.checkpoint.recipe, result.chosen
    names = ("steps", "best_step", "held_out_loss", "held_out_accuracy", "psnr")
    metrics = {name: _number(recipe[name]) for name in names if name in recipe}
    events = (EventRow("keyframes", ", ".join(map(str, chosen))),)
    return Findings(metrics=metrics, costs={"fit_s": _number(recipe.get("seconds"))}, events=events)


def _refine(job: Job) -> Findings:
    from semantic_mapper.replay.jobs import RefineRequest, refine_map

    settings: RefineSettings = job.settings
    request = RefineRequest(job.log, job.out / "map.npz", job.weights, settings.fill, settings.up, settings.by_name)
    report = refine_map(request).report
    metrics = {name: _number(getattr(report, name)) for name in ("surface", "relabelled", "filled", "things")}
    return Findings(metrics=metrics)


OPERATIONS: Mapping[str, Operation] = {
    "replay": Operation(ReplaySettings, _MAPPER, _replay, memory_gb=2.0),
    "eval": Operation(EvalSettings, _MAPPER, _eval, memory_gb=2.0),
    "autolabel": Operation(AutolabelSettings, _MAPPER, _autolabel, memory_gb=2.0),
    "finetune": Operation(FinetuneSettings, _FIT, _finetune, memory_gb=4.0),
    "refine": Operation(RefineSettings, "", _refine, memory_gb=4.0, suffix=MAP_SUFFIX),
}


def _with_delay(config: MapperConfig) -> MapperConfig:
    """As ``replay`` has it: nobody waits for the map of a log, so that computed depth may wait for later frames."""
    from semantic_mapper.replay.jobs import OFFLINE

    if config.depth.from_motion.delay_frames:
        return config
    data: dict[str, Any] = to_plain(config)
    for name, value in OFFLINE.items():
        assign(data, name, value, "mapper")
    return convert_config(data, MapperConfig, "mapper")


def _events(summary: Mapping[str, Any]) -> tuple[EventRow, ...]:
    """What a person may want to look at in a replay."""
    from semantic_mapper.replay.summary import notes

    events = [EventRow("note", text) for text in notes(summary)]
    events += [EventRow("damaged", text) for text in summary["damaged_stretches"]]
    events += [EventRow("refused", r["reason"], r["seq"], r["stamp_ns"]) for r in summary["refusals"]]
    return tuple(events[:MAX_EVENTS])


def _segments(method: str, segments: Segments) -> list[SegmentRow]:
    names = tuple(segments.label_set.names)
    return [
        SegmentRow(method, s.first, s.frames, names, tuple(s.confusion.counts.ravel().tolist())) for s in segments.all()
    ]


def _write_thumbnail(session: MapSession, out: Path) -> str:
    """A frame beside what was rendered for it, for reports of many logs; its name, empty where no frame was mapped."""
    import cv2

    if not session.snapshots:
        return ""
    frame, update = session.snapshots[len(session.snapshots) // 2]
    pixels = np.hstack((frame.rgb, session.pipeline.label_set.colorize(update.label)))
    height = max(round(pixels.shape[0] * THUMBNAIL_WIDTH / pixels.shape[1]), 1)
    small = cv2.resize(pixels, (THUMBNAIL_WIDTH, height), interpolation=cv2.INTER_AREA)
    (out / THUMBNAIL).write_bytes(cv2.imencode(".jpg", small[:, :, ::-1])[1].tobytes())
    return THUMBNAIL


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
