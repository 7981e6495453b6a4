"""Replay a log in this process: what the verbs ``replay``, ``demo`` and ``eval`` share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import structlog

from semantic_mapper.config import (
    DepthSource,
    MapperConfig,
    Quality,
    check_quality,
    convert_config,
    read_toml,
)
from semantic_mapper.errors import LogError, SemanticMapperError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.outputs import hold_folder
from semantic_mapper.nodes.mapper.finish import finish_session
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.artifacts import clear_results
from semantic_mapper.replay.corrected_poses import correct_session, keeping_frames, read_corrections
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.replay.session import MapSession, open_recording
from semantic_mapper.replay.sfm.film import read_left_out
from semantic_mapper.replay.sfm.scale import fit_to_scene
from semantic_mapper.types import PosedFrame

REPLAY_DELAY_FRAMES = 6  # that a frame waits for where its depth is computed: nobody waits for the map of a log

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """What to replay.

    Args:
        log: The log, or a folder with the parts of a recording.
        out: Folder for the results.
        weights: None = those that ship with the package.
        config: Of the mapper.
        max_frames: 0 = all.
        exclude: Weights whose finetuning frames are left out of the scores, beside those of ``weights``.
        rerun: Where to write a Rerun recording.
        corrections: Trajectory file with corrected poses, which the map is moved to at the end of the log.
        further_parts: Of the recording that ``log`` is a part of.
    """

    log: Path
    out: Path
    weights: Path | None = None
    config: MapperConfig = field(default_factory=MapperConfig)
    max_frames: int = 0
    exclude: Path | None = None
    rerun: Path | None = None
    corrections: Path | None = None
    further_parts: tuple[Path, ...] = ()


def replay_log(
    request: ReplayRequest, stop: StopRequest, on_start: Callable[[int], None], on_frame: Callable[[int], None]
) -> dict[str, Any]:
    """Map a log and write summary, map and picture; after a stop request, those of the frames so far.

    Damaged frames of the log and frames that the mapper refuses are counted and reported; the rest is mapped.

    Args:
        request: What to do.
        stop: Looked at before every frame.
        on_start: Called with how many frames there are.
        on_frame: Called with how many are done.

    Returns:
        The summary, as in ``summary.json``; ``stopped_by`` names the signal that ended it early, else null.

    Raises:
        LogError, WeightsError, ConfigError, MapError: nothing could be mapped; the message says why.
        ImportSourceError: the corrections cannot be read.
    """
    return replay_session(request, stop, on_start, on_frame)[0]


def replay_session(
    request: ReplayRequest, stop: StopRequest, on_start: Callable[[int], None], on_frame: Callable[[int], None]
) -> tuple[dict[str, Any], MapSession]:
    """``replay_log``, and the session that its summary is of."""
    trajectory = read_corrections(request.corrections) if request.corrections else None
    exclude = load_checkpoint(request.exclude).train_stamps_ns if request.exclude else frozenset[int]()
    with hold_folder(request.out), open_log((request.log, *request.further_parts)) as log:
        for notice in log.notices:
            _log.warning("log_notice", notice=notice)
        config, fitted = fit_to_scene(request.config, log.info)
        if fitted:
            _log.warning("settings_fitted", to=fitted)
        config = config if trajectory is None else keeping_frames(config, len(log))
        bundle = Mapper.load(request.weights, config)
        clear_results(request.out)
        session = MapSession(
            bundle,
            stream_labels=log.info.label_set,
            exclude_stamps=exclude,
            source=log.info.source,
            scale_known=log.info.scale_known,
            rerun=open_recording(request.rerun, bundle.pipeline),
        )
        session.left_out = read_left_out(log.attachments())
        for error in log.errors:  # stretches of the file in which no frame can be made out
            session.note_damage(str(error))
        total = min(len(log), request.max_frames or len(log))
        on_start(total)
        _log.info("mapping", log=request.log.name, frames=total, weights=bundle.weights_path.name)
        try:
            done = _map_frames(session, log, total, stop, on_frame)
            if trajectory is not None and not stop:
                correct_session(session, trajectory)
        except SemanticMapperError:  # the map is full, for one: what is in it is worth keeping
            finish_session(session, request.out, "error")
            raise
        summary = finish_session(session, request.out, stop.name)
    if not session.fused:
        reason = summary["map"]["nearly_empty"] or "no frame has depth or finds a source view"
        reason = session.refusals.first[0].reason if session.refusals else reason
        raise LogError(f"{request.log}: none of {counted(done, 'frame')} could be mapped; the first: {reason}")
    return summary, session


def _map_frames(session: MapSession, log: Log, total: int, stop: StopRequest, on_frame: Callable[[int], None]) -> int:
    """Feed the session; how many frames were looked at."""
    done = 0
    for done, item in enumerate(log.frames_or_errors(total), 1):
        if isinstance(item, PosedFrame):
            session.process(item)
        else:
            session.refuse(done - 1, 0, str(item))
        on_frame(done)
        if stop:
            _log.warning("stopped", by=stop.name, frames=done, of=total)
            break
    return done


def mapper_config(
    path: Path | None,
    voxel_size_m: float | None,
    seed: int | None = None,
    quality: Quality | None = None,
    depth: DepthSource | None = None,
    delay_frames: int = 0,
    live: bool = False,
    history_frames: int = 0,
) -> MapperConfig:
    """The mapper's config from a TOML file (None = defaults) with what the command line says on top.

    Args:
        path: The file.
        voxel_size_m, seed, quality, depth: What the command line says, None = nothing.
        delay_frames: How many later frames one may wait for whose depth is computed, where the file does not say it.
        live: No frame waits for the bundle of poses.
        history_frames: Kept for corrections, where the file does not say it; 0 = none.

    Raises:
        ConfigError: see ``load_config`` and ``check_quality``.
    """
    data = read_toml(path) if path else {}
    config = convert_config(data, MapperConfig, str(path))
    check_quality(data, quality or config.quality, str(path))
    if voxel_size_m is not None:
        voxel_map = msgspec.structs.replace(config.voxel_map, voxel_size_m=voxel_size_m)
        config = msgspec.structs.replace(config, voxel_map=voxel_map)
    if live:
        config = msgspec.structs.replace(config, depth=msgspec.structs.replace(config.depth, refine_in_background=True))
    if "delay_frames" not in data.get("depth", {}).get("from_motion", {}):
        from_motion = msgspec.structs.replace(config.depth.from_motion, delay_frames=delay_frames)
        config = msgspec.structs.replace(config, depth=msgspec.structs.replace(config.depth, from_motion=from_motion))
    if history_frames and not config.history.max_frames:
        history = msgspec.structs.replace(config.history, max_frames=history_frames)
        config = msgspec.structs.replace(config, history=history)
    if depth is not None:
        config = msgspec.structs.replace(config, depth=msgspec.structs.replace(config.depth, source=depth))
    given = {"seed": seed, "quality": quality}
    return msgspec.structs.replace(config, **{name: value for name, value in given.items() if value is not None})
