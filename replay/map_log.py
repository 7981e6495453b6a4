"""Map a log into a folder of results, as the command line, the demo and the fleet do. Nothing here needs torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import EmptyMapError, SemanticMapperError
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.artifacts import clear_results, finish_session, result_steps
from semantic_mapper.replay.corrected_poses import correct_session, keeping_frames, read_corrections
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import hold_folder
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
