"""Score a log with several methods: progress, and the figures as plain data and as a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from rich.table import Table

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import LabelError, WeightsError
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.map_scale import require_metres
from semantic_mapper.nodes.cli.console import frame_progress
from semantic_mapper.nodes.cli.summary_table import percent
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.evaluate.methods import (
    Evaluation,
    baseline_predictors,
    evaluate_frames,
    field_predictors,
    thing_tellers,
)
from semantic_mapper.replay.evaluate.panoptic_truth import InstanceFolder, PanopticTruth
from semantic_mapper.replay.evaluate.shortfall import explain_shortfall
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.types import PosedFrame


@dataclass(frozen=True, slots=True)
class ScoreRequest:
    """What the verb was requested; ``weights`` None = those in the package, ``max_frames`` 0 = all. ``instances`` is a
    folder, or None."""

    log: Path
    weights: Path | None
    baselines: bool
    seconds: float
    max_frames: int
    config: MapperConfig
    seed: int
    instances: Path | None = None


def score_log(request: ScoreRequest) -> dict[str, Any]:
    """Run the methods over a log.

    Returns:
        ``methods`` (metrics by name), ``scored``, ``excluded``, ``refused``, ``damaged``, ``weights``, and ``notes``:
        why the field is below its own image alone or the U-Net, where it is.

    Raises:
        LogError, LabelError, WeightsError: nothing can be scored.
    """
    return evaluate_log(request)[0]


def evaluate_log(request: ScoreRequest) -> tuple[dict[str, Any], Evaluation]:
    """``score_log``, and what it was made of.

    Raises:
        LogError, LabelError, WeightsError: nothing can be scored.
    """
    with open_log(request.log) as log:
        stream_labels = log.info.label_set
        if stream_labels is None:
            raise LabelError(f"{request.log}: has no label images to score against")
        check_scorable(log)
        bundle = Mapper.load(request.weights, _frame_by_frame(request.config))
        if not bundle.checkpoint.model.knows_classes:
            raise WeightsError(
                f"{bundle.weights_path}: a field of kind '{bundle.checkpoint.model.kind}' knows no classes, so that "
                "there is nothing to score; give weights that were trained on labels"
            )
        panoptic = None
        if request.instances is not None:
            require_metres(log.info.scale_known, "instances")
            panoptic = PanopticTruth(InstanceFolder(request.instances, log), stream_labels, bundle.checkpoint.label_set)
        predictors = field_predictors(bundle)
        stamps = bundle.checkpoint.train_stamps_ns
        if request.baselines:
            keyframes = _frames_at(log, stamps)
            with frame_progress("fit the U-Net", 100, unit="%") as bar:
                predictors |= baseline_predictors(
                    keyframes,
                    bundle.checkpoint.label_set,
                    request.seconds,
                    request.seed,
                    lambda fraction: bar.set(int(fraction * 100)),
                )
        total = min(len(log), request.max_frames or len(log))
        frames = (frame for _, frame in zip(range(total), log, strict=False))
        with frame_progress("score", total) as bar:
            found = evaluate_frames(
                frames,
                predictors,
                stream_labels,
                bundle.checkpoint.label_set,
                stamps,
                on_frame=bar.set,
                voxel_map=bundle.pipeline.voxel_map,
                panoptic=panoptic,
                things=thing_tellers(bundle),
            )
        model, recipe = bundle.checkpoint.model, bundle.checkpoint.recipe
        shortfall = explain_shortfall(model.kind, found.methods, recipe)
        return {
            **found.plain(),
            "damaged": len(log.errors),
            "weights": bundle.weights_path.name,
            "notes": list(shortfall),
        }, found


def check_scorable(log: Log) -> None:
    """Make sure that not all labels of a log were rendered by weights.

    Raises:
        LabelError: they were.
    """
    pseudo = 0
    for envelope, _ in log.frame_parts():
        if envelope.has_label and not envelope.has_pseudo_label:
            return
        pseudo += envelope.has_pseudo_label
    if pseudo:
        note = read_note(log.attachments())
        by = f" that {note.weights} has rendered" if note is not None else ""
        raise LabelError(
            f"{log.path}: there is no score: all of its {counted(pseudo, 'label image')} are pseudo labels{by}, "
            "which are no truth; score on the log that it was made of, or on labels of your own"
        )


def _frame_by_frame(config: MapperConfig) -> MapperConfig:
    """Scores are of each frame as it comes: computed depth does not wait for later ones."""
    from_motion = msgspec.structs.replace(config.depth.from_motion, delay_frames=0)
    return msgspec.structs.replace(config, depth=msgspec.structs.replace(config.depth, from_motion=from_motion))


def _frames_at(log: Log, stamps: frozenset[int]) -> list[PosedFrame]:
    numbers = [i for i, (envelope, _) in enumerate(log.frame_parts()) if envelope.stamp_ns in stamps]
    if len(numbers) < 2:
        raise WeightsError(
            f"--baselines are fitted to the keyframes that the weights were finetuned on, but {len(numbers)} of them "
            f"are in {log.path}; give --weights that `semantic-mapper finetune` has made from this log"
        )
    return [log.frame(i) for i in numbers]


def score_table(title: str, scores: Mapping[str, Any]) -> Table:
    """One column a method."""
    methods: Mapping[str, Mapping[str, Any]] = scores["methods"]
    counts = f"{scores['scored']} frames scored, {scores['excluded']} left out as keyframes"
    if scores["pseudo_labelled"]:
        counts += f", {scores['pseudo_labelled']} with pseudo labels"
    table = Table(title=f"{title}: {counts}", title_justify="left")
    table.add_column("")
    for name in methods:
        table.add_column(name, justify="right")
    for key, text in (
        ("miou", "mIoU"),
        ("total_accuracy", "total accuracy"),
        ("average_accuracy", "average accuracy"),
        ("coverage", "coverage"),
        ("ece", "calibration error"),
        ("sure", "confidence above 0.9"),
        ("sure_right", "of these right"),
        ("pq", "PQ"),
        ("sq", "SQ"),
        ("rq", "RQ"),
        ("pq_plus", "PQ+"),
        ("pq_things", "PQ of things"),
        ("open_set_auroc", "AUROC, classes it lacks"),
        ("open_set_unknown", "unknown, of classes it lacks"),
    ):
        if any(m.get(key) is not None for m in methods.values()):
            table.add_row(text, *(_show(m.get(key)) for m in methods.values()))
    table.add_section()
    for name in dict.fromkeys(n for m in methods.values() for n in m["per_class"]):
        table.add_row(f"IoU {name}", *(_show(m["per_class"].get(name)) for m in methods.values()))
    table.add_section()
    of_things = [m.get("pq_per_class", {}) for m in methods.values()]
    for name in dict.fromkeys(n for classes in of_things for n in classes):
        table.add_row(f"PQ {name}", *(_show(c[name]["pq"] if name in c else None) for c in of_things))
    return table


def _show(value: float | None) -> str:
    return "-" if value is None else percent(value)
