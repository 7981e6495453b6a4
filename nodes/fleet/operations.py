"""What a fleet can do with one log: the jobs of ``replay.jobs``, each with its settings and its findings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

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
)
from semantic_mapper.evaluation.metrics import Segments, class_sums
from semantic_mapper.files import write_json
from semantic_mapper.nodes.fleet.store import Findings, MethodScores
from semantic_mapper.replay.evaluate.report import score_table, write_eval_report
from semantic_mapper.replay.jobs import (
    OFFLINE,
    AutolabelRequest,
    FinetuneRequest,
    autolabel_log,
    evaluate_log,
    finetune_log,
    refine_map,
    replay_log,
)
from semantic_mapper.replay.run_folder import MAP_NAME
from semantic_mapper.replay.summary import dig, notes
from semantic_mapper.training.config import FinetuneConfig

_MAX_EVENTS = 200  # of one log
_SCORES = ("miou", "total_accuracy", "average_accuracy", "coverage")

ConfigT = TypeVar("ConfigT", bound=Config)


class LogSettings(MapperConfig, frozen=True):
    """Of ``replay`` and ``eval``: those of the mapper, and ``max_frames`` (0 = all)."""

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


class RefineSettings(Config, frozen=True):
    """Of ``refine``."""

    fill: Fraction = 0.5
    up: str = "auto"
    by_name: bool = False


@dataclass(frozen=True, slots=True)
class Operation:
    """One of ``OPERATIONS``."""

    settings: type[Config]  # kind of its settings
    # does it: log, empty folder for files of the result, weights (None = those that ship), settings
    run: Callable[[Path, Path, Path | None, Any], Findings]
    memory_gb: float = 2.0  # a task is given at least so much, unless the user says otherwise
    defaults: Mapping[str, Any] = field(default_factory=dict[str, Any])  # settings that differ from those of the kind


def read_settings(
    operation: str, assignments: Sequence[str], config: Path | None = None
) -> tuple[Config, dict[str, Any]]:
    """Settings of an operation.

    Args:
        operation: Of ``OPERATIONS``.
        assignments: What ``--set NAME=VALUE`` says, such as ``max_frames=100`` or ``voxel_map.voxel_size_m=0.05``.
        config: TOML file with the same names; assignments go before it.

    Returns:
        The settings, and as plain data what was set.

    Raises:
        ConfigError: no such setting, with the nearest one; or a value that it cannot have.
    """
    found = OPERATIONS[operation]
    plain = {} if config is None else read_toml(config)
    for name, value in parse_assignments(assignments).items():
        assign(plain, name, value, "--set")
    data = copy.deepcopy(plain)
    for name, value in found.defaults.items():
        assign(data, name, value, "--set", replace=False)
    settings = convert_config(data, found.settings, "--set")
    if isinstance(settings, MapperConfig):
        check_quality(plain, settings.quality, "--set")
    return settings, plain


def _replay(log: Path, out: Path, weights: Path | None, settings: LogSettings) -> Findings:
    result = replay_log(log, out, weights, _part(settings, MapperConfig), settings.max_frames)
    summary = result.summary
    metrics = {name: dig(summary, f"metrics.{name}") for name in (*_SCORES, "map_miou")}
    metrics |= {f"frames_{name}": count for name, count in summary["frames"].items()}
    metrics |= {name: summary["map"][name] for name in ("surface_points", "blocks", "cleared_voxels", "unknown")}
    metrics["depth_disagreement"] = dig(summary, "pose_check.worst_depth_disagreement")
    costs = {f"step_ms_{name}": value for name, value in summary["latency_ms"].items()}
    events = [("note", text) for text in notes(summary)]
    events += [("damaged", text) for text in summary["damaged_stretches"]]
    events += [("refused", f"frame {r['seq']}: {r['reason']}") for r in summary["refusals"]]
    return Findings(
        metrics=metrics,
        costs={**costs, "map_memory_mb": summary["map"]["memory_mb"]},
        scores=(_scores("replay", dig(summary, "metrics.per_class") or {}, result.session.segments),),
        events=tuple(events[:_MAX_EVENTS]),
    )


def _eval(log: Path, out: Path, weights: Path | None, settings: LogSettings) -> Findings:
    result = evaluate_log(log, weights, _part(settings, MapperConfig), settings.max_frames)
    scores = result.plain()
    found: dict[str, Any] = {"replays": {}, "logs": {log.name: scores}}
    write_json(out / "eval.json", found)
    write_eval_report(out / "eval.html", {}, [], {log.name: score_table(log.name, scores)}, found)
    methods: Mapping[str, Mapping[str, Any]] = scores["methods"]
    main = next(iter(methods.values()))
    metrics = {key: main.get(key) for key in (*_SCORES, "ece")}
    metrics |= {f"miou {method}": figures.get("miou") for method, figures in methods.items()}
    metrics |= {f"frames_{key}": scores[key] for key in ("scored", "excluded", "refused", "damaged", "pseudo_labelled")}
    return Findings(
        metrics=metrics,
        scores=tuple(_scores(method, f["per_class"], result.segments.get(method)) for method, f in methods.items()),
    )


def _autolabel(log: Path, out: Path, weights: Path | None, settings: AutolabelSettings) -> Findings:
    request = AutolabelRequest(
        (log,),
        out / "labelled.mcap",
        weights,
        _part(settings, MapperConfig),
        settings.write_depth,
        settings.min_confidence,
        settings.overwrite_labels,
        settings.max_frames,
    )
    report = autolabel_log(request)
    figures = ("frames", "labelled", "kept", "replaced", "unlabelled", "depth_written", "mean_confidence")
    events = [("unlabelled", text) for text in report.unlabelled]
    events += [("damaged", text) for text in report.damage]
    return Findings(
        metrics={name: getattr(report.note, name) for name in (*figures, "labelled_pixels")},
        events=tuple(events[:_MAX_EVENTS]),
    )


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
    result = finetune_log(request)
    recipe = result.checkpoint.recipe
    names = ("steps", "best_step", "held_out_loss", "held_out_accuracy", "psnr")
    return Findings(
        metrics={name: recipe[name] for name in names if name in recipe},
        costs={"fit_s": recipe.get("seconds")},
        events=(("keyframes", ", ".join(map(str, result.chosen))),),
    )


def _refine(log: Path, out: Path, weights: Path | None, settings: RefineSettings) -> Findings:
    more = {"fill": settings.fill, "up": settings.up, "by_name": settings.by_name}
    report = refine_map(log, out / MAP_NAME, weights, **more).report
    return Findings(metrics={name: getattr(report, name) for name in ("surface", "relabelled", "filled")})


OPERATIONS: Mapping[str, Operation] = {
    "replay": Operation(LogSettings, _replay, defaults=OFFLINE),
    "eval": Operation(LogSettings, _eval),
    "autolabel": Operation(AutolabelSettings, _autolabel, defaults=OFFLINE),
    "finetune": Operation(FinetuneSettings, _finetune, memory_gb=4.0),
    "refine": Operation(RefineSettings, _refine, memory_gb=4.0),
}


def _part(settings: Config, kind: type[ConfigT]) -> ConfigT:
    """Those settings that a job's own config has."""
    return kind(**{name: getattr(settings, name) for name in kind.__struct_fields__})


def _scores(method: str, iou: dict[str, float | None], segments: Segments | None) -> MethodScores:
    if segments is None:
        return MethodScores(method, iou)
    parts = segments.all()
    sums = [class_sums(part.confusion.counts) for part in parts]
    return MethodScores(
        method,
        iou,
        tuple(segments.label_set.names),
        tuple(tuple(tuple(row) for row in part.tolist()) for part in sums),
        tuple(part.first for part in parts),
    )
