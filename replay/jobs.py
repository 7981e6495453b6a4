"""What can be done with a log or a map: nothing here prints.

The command line, the nodes and the fleet call these; ``finetune_log`` and ``autolabel_log`` have modules of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import EmptyMapError, LabelError, SemanticMapperError, WeightsError
from semantic_mapper.fields.nesf import find_nesf
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.mapping.refine import RefineReport, refine
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.artifacts import clear_results, finish_session, result_steps
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.corrected_poses import correct_session, keeping_frames, read_corrections
from semantic_mapper.replay.evaluate import methods
from semantic_mapper.replay.evaluate.things import PanopticTruth
from semantic_mapper.replay.exporters.map_files import parse_up
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.replay.run_folder import hold_folder, prepare_file
from semantic_mapper.replay.session import MapSession, open_recording
from semantic_mapper.replay.sfm.film import read_left_out
from semantic_mapper.replay.sfm.scale import fit_to_scene
from semantic_mapper.transport.messages import SCALE_KEY
from semantic_mapper.types import PosedFrame

if TYPE_CHECKING:
    from semantic_mapper.mapping.pipeline import MappingPipeline
    from semantic_mapper.replay.rerun_log import RerunLog

# Of the mapper, where its settings say nothing: nobody waits for the map of a log, so that a frame whose depth is
# computed waits for later ones.
OFFLINE = {"depth.from_motion.delay_frames": 6}

_log = get_logger(__name__)


def replay_log(
    log: Path | Sequence[Path],
    out: Path,
    weights: Path | None = None,
    config: MapperConfig | None = None,
    max_frames: int = 0,
    *,
    rerun: Path | None = None,
    watch: Callable[[MappingPipeline], RerunLog] | None = None,
    corrections: Path | None = None,
    monitor: JobMonitor | None = None,
) -> tuple[dict[str, Any], MapSession]:
    """Map a log and write summary, map, pictures and report; after a stop request, those of the frames so far. Returns
    the summary, and the session that it is of.

    Damaged frames of the log and frames that the mapper refuses are counted and reported; the rest is mapped. Raises
    LogError, WeightsError, ConfigError, MapError: nothing could be mapped; the message says why. EmptyMapError: no
    frame was, with the results written all the same. ImportSourceError: the corrections cannot be read.

    ``log`` may be a folder with the parts of a recording, or these parts; ``max_frames`` 0 means all. A Rerun recording
    goes to ``rerun``, or to what ``watch`` makes of the pipeline. ``corrections`` is a trajectory file that the map is
    moved to at the end of the log. ``monitor`` gets the progress, and may end it early; ``stopped_by`` of the summary
    names the signal.
    """
    monitor = monitor or JobMonitor()
    trajectory = read_corrections(corrections) if corrections else None
    with hold_folder(out), open_log(log) as source:
        for notice in source.notices:
            _log.warning("log_notice", notice=notice)
        config, fitted = fit_to_scene(config or MapperConfig(), source.info)
        if fitted:
            _log.warning("settings_fitted", to=fitted)
        config = config if trajectory is None else keeping_frames(config, len(source))
        mapper = Mapper.load(weights, config)
        clear_results(out)
        mapper.voxel_map.note_scale(source.info.scale_known)
        session = MapSession(
            mapper,
            stream_labels=source.info.label_set,
            source=source.info.source,
            rerun=open_recording(rerun, mapper.pipeline) if watch is None else watch(mapper.pipeline),
        )
        session.left_out = read_left_out(source.attachments())
        session.scale_from = source.info.metadata.get(SCALE_KEY, "")
        for error in source.errors:  # stretches of the file in which no frame can be made out
            session.note_damage(str(error))
        total = min(len(source), max_frames or len(source))
        monitor.start(total)
        _log.info("mapping", log=source.path.name, frames=total, weights=mapper.weights_path.name)
        try:
            for number, item in enumerate(source.frames_or_errors(total)):
                if isinstance(item, PosedFrame):
                    session.process(item)
                else:
                    session.refuse(number, 0, str(item))
                monitor.set(number + 1)
                if monitor.stopped_by:
                    _log.warning("stopped", by=monitor.stopped_by, frames=number + 1, of=total)
                    break
            if trajectory is not None and not monitor.stopped_by:
                correct_session(session, trajectory)
        except SemanticMapperError:  # the map is full, for one: what is in it is worth keeping
            finish_session(session, out, "error")
            raise
        monitor.start(result_steps(session), "write the results")
        written = count(1)
        summary = finish_session(session, out, monitor.stopped_by, progress=lambda: monitor.set(next(written)))
    if not session.fused:
        empty = summary["map"]["nearly_empty"] or "no frame has depth or finds a source view"
        reason = f"the first: {session.refusals.first[0].reason}" if session.refusals else empty
        raise EmptyMapError(f"{source.path}: none of {counted(session.published, 'frame')} could be mapped; {reason}")
    return summary, session


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


def refine_map(
    path: Path,
    out: Path,
    weights: Path | None = None,
    *,
    fill: float = 0.5,
    up: str = "auto",
    by_name: bool = False,
    monitor: JobMonitor | None = None,
) -> tuple[RefineReport, str]:
    """Relabel a saved map by its shape, colour and votes, into a new one; what has changed, and the digest of the
    network, or ``smoothed``.

    Raises ConfigError: ``up`` is no direction, or the new map cannot be written there. MapError, WeightsError: map and
    weights cannot be read, or do not go together.

    ``weights`` may be ``smoothed``; None = those that ship, or smoothing for a map of other classes. Surface without
    votes gets a class that is at least as likely as ``fill``, 1 = never. ``up`` is ``auto``, an axis, or three numbers;
    ``by_name`` matches weights of other classes by the names of these.
    """
    monitor = monitor or JobMonitor()
    direction = parse_up(up)
    prepare_file(out)
    voxel_map = VoxelMap.load(path)
    network = find_nesf(weights, voxel_map.label_set)

    def on_tile(done: int, total: int) -> None:
        if done == 1:
            monitor.start(total)
        monitor.set(done)

    report = refine(voxel_map, network, fill=fill, up=direction, by_name=by_name, on_tile=on_tile)
    voxel_map.save(out)
    return report, network.digest
