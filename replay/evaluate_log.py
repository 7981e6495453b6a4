"""Score weights against the label images of a log."""

from dataclasses import replace
from pathlib import Path

import msgspec

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import LabelError, WeightsError
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.evaluate import methods
from semantic_mapper.replay.evaluate.things import PanopticTruth
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.types import PosedFrame


def evaluate_log(
    log: Path,
    weights: Path | None = None,
    config: MapperConfig | None = None,
    max_frames: int = 0,
    *,
    baseline_s: float = 0.0,
    instances: Path | None = None,
    monitor: JobMonitor | None = None,
) -> methods.Evaluation:
    """Score a log with several methods. Raises LogError, LabelError, WeightsError: nothing can be scored.

    Computed depth never waits for later frames, since scores are of frames as they come. ``baseline_s``: also fit the
    baselines to the keyframes of the weights, the U-Net for so long; ``instances``: folder with images of the frames'
    true objects, without which things are not scored.
    """
    monitor, config = monitor or JobMonitor(), config or MapperConfig()
    from_motion = msgspec.structs.replace(config.depth.from_motion, delay_frames=0)
    depth = msgspec.structs.replace(config.depth, from_motion=from_motion)
    with open_log(log) as source:
        stream_labels = source.info.label_set
        if stream_labels is None:
            raise LabelError(f"{log}: has no label images to score against")
        _check_scorable(source)
        mapper = Mapper.load(weights, msgspec.structs.replace(config, depth=depth))
        weights_file = mapper.weights
        if not mapper.model.knows_classes:
            raise WeightsError(
                f"{mapper.weights_path}: a field of kind '{weights_file.kind}' knows no classes, so that "
                "there is nothing to score; give weights that were trained on labels"
            )
        panoptic = None
        if instances is not None:
            require_metres(source.info.scale_known, "instances")
            panoptic = PanopticTruth(instances, source, stream_labels, weights_file.label_set)
        predictors = methods.field_predictors(mapper)
        if baseline_s:
            monitor.start(100)
            predictors |= methods.baseline_predictors(
                _frames_at(source, weights_file.train_stamps_ns),
                weights_file.label_set,
                baseline_s,
                config.seed,
                lambda fraction: monitor.set(int(fraction * 100), "fitting the U-Net"),
            )
        total = min(len(source), max_frames or len(source))
        monitor.start(total)
        found = methods.evaluate_frames(
            (frame for _, frame in zip(range(total), source, strict=False)),
            predictors,
            stream_labels,
            weights_file.label_set,
            weights_file.train_stamps_ns,
            on_frame=lambda done: monitor.set(done, "scoring"),
            voxel_map=mapper.pipeline.voxel_map,
            panoptic=panoptic,
            things=methods.thing_tellers(mapper),
        )
        return replace(found, damaged=len(source.errors), weights=mapper.weights_path.name)


def _check_scorable(log: Log) -> None:
    """Make sure that not all labels of a log were rendered by weights."""
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


def _frames_at(log: Log, stamps: frozenset[int]) -> list[PosedFrame]:
    numbers = [i for i, (envelope, _) in enumerate(log.frame_parts()) if envelope.stamp_ns in stamps]
    if len(numbers) < 2:
        raise WeightsError(
            f"--baselines are fitted to the keyframes that the weights were finetuned on, but {len(numbers)} of them "
            f"are in {log.path}; give --weights that `semantic-mapper finetune` has made from this log"
        )
    return [log.frame(i) for i in numbers]
