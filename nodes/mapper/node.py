"""The mapper node: frames in, map updates out; at the end of the stream it writes the map."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import structlog
from msgspec import to_builtins

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.map_types import SCALE_FIX
from semantic_mapper.mapping.moving import KEPT_S
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.memory import give_back_freed_memory
from semantic_mapper.nodes.mapper import saved_map
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.live_weights import LiveWeights, started_with
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.nodes.mapper.saved_map import Autosave
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import MapperOptions
from semantic_mapper.nodes.publishing import PartStatus, PublicPublisher, StatusReport
from semantic_mapper.nodes.streams import MissingFrames, Streams
from semantic_mapper.queries.objects import visit_of
from semantic_mapper.queries.revisit import MapVisit
from semantic_mapper.replay.artifacts import clear_results, finish_session
from semantic_mapper.replay.run_folder import MAP_NAME, map_path, prepare_folder
from semantic_mapper.replay.session import MapSession, Refusal
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import Closing
from semantic_mapper.transport.keys import load_keys
from semantic_mapper.transport.messages import SCALE_KEY, EndOfStream, FrameRefused, NodeState, StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber
from semantic_mapper.types import MapUpdate, PosedFrame

POLL_S = 0.1
MAX_AGE_S = 60.0  # of a frame, by its stamp: more, or less than nothing, and its clock is not this machine's
TRIM_PERIOD_S = 10.0  # a node that runs for hours would otherwise hold more and more of what it has freed

_log = structlog.get_logger(__name__)


def run_mapper(context: NodeContext, options: MapperOptions) -> None:
    """Map until the stream ends or somebody asks to stop, then write the results."""
    prepare_folder(Path(options.out))
    with MapperNode(context, options) as mapper:
        context.heartbeat.ready()
        try:
            mapper.run()
        except BaseException as error:
            try:
                mapper.finish()
            except (SemanticMapperError, OSError) as second:  # must not hide the first
                _log.error("results_not_written", reason=str(second), after=str(error))
            raise
        context.heartbeat.ending()
        mapper.finish()


class MapperNode(Closing):
    """A mapper from its first message to its last file. A context manager."""

    def __init__(self, context: NodeContext, options: MapperOptions) -> None:
        self._context = context
        self._options = options
        self._out = Path(options.out)
        self._mapper, self._resumed, self._before = _load(context, options)
        self._pipeline = self._mapper.pipeline

        self._session: MapSession | None = None
        self._streams = Streams(len(options.cameras))
        self._missing_frames = MissingFrames()
        self._broken = context.restarts > 0  # the camera or the mapper was not there all the time
        self._corrected = False
        self._early = 0  # frames before their stream was announced
        self._step_us = 0  # that all steps took
        self._capture_age_s: float | None = None
        self._ended_by = "error"
        self._last_trim = time.monotonic()

        self._correction = LiveCorrection(self._pipeline)
        self._autosave = Autosave(self._mapper.voxel_map, self._out / MAP_NAME, options.save_every_s)
        with ExitStack() as stack:
            publisher = PublicPublisher(context.endpoint(context.name), options.publish, options.keys)
            self._publisher = stack.enter_context(publisher)
            self._report = StatusReport(context.name, self._publisher)
            subscriber = LosslessSubscriber if options.delivery == "all" else NewestSubscriber
            endpoints = [context.endpoint(name) for name in options.cameras]
            self._frames = stack.enter_context(subscriber(endpoints, ("info", "frame", "end")))
            self._weights: LiveWeights | None = None
            if options.learner:
                self._weights = stack.enter_context(LiveWeights(context, options, self._mapper, self._publisher))
            self._queries: QueryService | None = None
            if options.query:
                service = QueryService(
                    context.endpoint(options.query),
                    self._mapper.voxel_map,
                    self._correction,
                    load_keys(Path(options.keys).expanduser()) if options.keys else None,
                    self._weights or started_with(self._mapper),
                    self._pipeline.moving.space,
                    lambda: self._pipeline.last_pose,
                    self._before,
                )
                self._queries = stack.enter_context(service)
            self._resources = stack.pop_all()
        _log.info("ready", weights=self._mapper.weights_path.name, input=options.cameras, delivery=options.delivery)

    def close(self) -> None:
        """Free its sockets and threads."""
        self._resources.close()

    def run(self) -> None:
        """Handle messages until the end of the stream or a stop request."""
        while not self._context.stop:
            self._context.heartbeat.turn()
            message = self._frames.receive(0.0 if self._correction.running else POLL_S)
            match message:
                case StreamInfo():
                    self._begin_stream(message)
                case PosedFrame():
                    self._map(message)
                case EndOfStream():
                    if self._end_stream(message):
                        return
                case _ if (self._frames.silent_s or 0) > KEPT_S:  # nothing is known any more of where what moves is
                    self._pipeline.moving.space.clear()
            self._between_frames(mapped=isinstance(message, PosedFrame))
        self._ended_by = self._context.stop.name

    def _between_frames(self, *, mapped: bool) -> None:
        """Let every part that works next to mapping do a little."""
        self._note_correction()
        self._correction.advance(self._session, mapped=mapped)
        if self._weights is not None:
            self._weights.advance(self._session, mapped=mapped)
        if self._queries is not None:
            self._queries.follow()
        self._autosave.follow()
        self._publish_status("running")
        if time.monotonic() - self._last_trim > TRIM_PERIOD_S:
            give_back_freed_memory()
            self._last_trim = time.monotonic()

    def _begin_stream(self, info: StreamInfo) -> None:
        # A stream is announced again to a newcomer, or by a restarted camera; or another camera begins.
        self._broken |= self._streams.begin(info)
        self._mapper.voxel_map.note_scale(info.scale_known)  # of further streams, too
        if self._session is not None:
            self._session.source = self._streams.source
            return
        if self._options.delivery == "newest":
            saved_map.keep_earlier(self._context, self._out / MAP_NAME)
        clear_results(self._out)
        self._session = MapSession(
            self._mapper, stream_labels=info.label_set, source=info.source, own_first=not self._options.map
        )
        self._session.scale_from = info.metadata.get(SCALE_KEY, "")
        if self._mapper.voxel_map.frames:
            self._session.odometry_sessions.known.update(saved_map.noted_sessions(self._context))
        _log.info("stream_begins", source=info.source, frames=info.frame_count)

    def _map(self, frame: PosedFrame) -> None:
        session = self._session
        if session is None:
            self._early += 1
            _log.warning("frame_before_stream_info", seq=frame.seq)
            return
        self._missing_frames.note(frame.camera_id, frame.seq)
        self._streams.note_frame(frame.camera_id)
        before = len(session.odometry_sessions.known)
        results = session.process(frame)
        if len(session.odometry_sessions.known) != before:
            saved_map.note_sessions(self._context, session.odometry_sessions.known)
        if not results and session.odometry_sessions.held:  # a player in lockstep waits for an answer to every frame
            self._refuse(frame, session.odometry_sessions.warning)
        self._capture_age_s = (time.monotonic_ns() - frame.stamp_ns) / 1e9
        for result in results:
            if isinstance(result, MapUpdate):
                self._step_us += round(1e3 * sum(result.stage_ms.values()))
                self._publisher.publish(encode(result))
            else:
                self._refuse(result, result.reason)

    def _refuse(self, frame: PosedFrame | Refusal, reason: str) -> None:
        self._publisher.publish(encode(FrameRefused(frame.stamp_ns, frame.seq, frame.camera_id, reason)))

    def _note_correction(self) -> None:
        """Frames after a correction may still come with poses from before it: a restarted mapper could not tell."""
        if not self._corrected and self._pipeline.corrector.status.poses:
            self._corrected = True
            why = "poses had been corrected, which only the mapper that was killed knew of"
            noted = saved_map.forbid(self._context, why)
            if not noted and self._options.save_every_s:
                self._autosave.end("poses were corrected, and no note could say so to a mapper that replaces this one")

    def _end_stream(self, end: EndOfStream) -> bool:
        """One stream has ended; True where all have."""
        if self._streams.knows(end):
            return False
        session = self._session
        if session is not None:
            for damage in end.damages:
                session.note_damage(damage)
            if end.unreadable:
                session.refuse_unreadable(end.unreadable, end.damages)
        _log.info("stream_ends", reason=end.reason, published=end.published, detail=end.detail)
        if not self._streams.end(end):
            return False
        self._ended_by = self._streams.ended_by
        if session is not None:
            # A camera that was restarted has not counted all that we have had.
            broken = self._broken or self._missing_frames.restarts > 0
            missed = self._missing_frames.missed if broken else max(0, self._streams.published - session.received)
            session.count_dropped(missed)
        return True

    def finish(self) -> None:
        """Write what there is."""
        self._frames.close()  # the camera waits until all have left
        if self._session is None:
            if not self._mapper.voxel_map.frames:
                _log.warning("nothing_to_write", reason="no stream has begun")
                return
            self._session = MapSession(self._mapper, stream_labels=None)  # of the map that was saved before a restart
        self._publish_status("stopping", now=True)
        self._autosave.close()
        self._correction.finish(self._session, lambda: bool(self._context.stop), self._while_correcting)
        if self._queries is not None:
            self._queries.hand_over()  # questions are answered while the map is written
        if self._weights is not None:
            self._session.learned = to_builtins(self._weights.end())
        results = self._session, self._out, self._ended_by, self._resumed, self._step_of_results
        summary = finish_session(*results, self._before)
        _log.info("map_written", out=str(self._out), **summary["frames"])
        self._publish_status("ended", now=True)

    def _step_of_results(self) -> None:
        give_back_freed_memory()  # each step needs other memory
        self._step_of_finish()

    def _step_of_finish(self) -> None:
        self._context.heartbeat.turn()
        self._publish_status("stopping")

    def _while_correcting(self) -> None:
        self._step_of_finish()
        if self._queries is not None:
            self._queries.follow()

    def _publish_status(self, state: NodeState, *, now: bool = False) -> None:
        if now or self._report.due:
            parts = (self._correction, self._weights, self._queries, self._autosave)
            self._report.publish(state, self._own_status(), *(part.status() for part in parts if part is not None))

    def _own_status(self) -> PartStatus:
        counters = {"rejected": self._frames.rejected, "early": self._early, "missed": self._missing_frames.missed}
        pipeline, warnings = self._pipeline, [self._resumed]
        if (session := self._session) is not None:
            sessions = session.odometry_sessions
            counters |= {
                "published": session.published,
                "fused": session.fused,
                "refused": len(session.refusals),
                "dropped": session.dropped,
                "cleared": pipeline.voxel_map.cleared,
                "moving": pipeline.moving.pixels,
                "step_us": self._step_us,
                "held": sessions.held,
                "relocalized": sessions.found,
                "not_found": sessions.refused.total(),
            }
            warnings += [sessions.warning, *session.warnings]
        if not pipeline.voxel_map.scale_known:
            warnings.append(f"scale: unknown; lengths of the map are not metres: {SCALE_FIX}")
        counters |= pipeline.picture_check.counters
        warnings += [*pipeline.picture_check.warnings, pipeline.pose_check.warning]
        silent, age_s = self._frames.silent_s, self._capture_age_s
        ages_s = self._streams.ages_s | ({} if silent is None else {"frame": silent})
        if age_s is not None and 0 <= age_s < MAX_AGE_S:
            ages_s["capture"] = age_s
        return PartStatus(counters, tuple(warnings), ages_s)


def _load(context: NodeContext, options: MapperOptions) -> tuple[Mapper, str, MapVisit | None]:
    """Weights and pipeline, with the map that is continued; what became of that of a process before this one; and the
    continued map as it is now."""
    path = Path(options.config) if options.config else None
    given = {
        "voxel_map.voxel_size_m": options.voxel_size_m or None,
        "depth.source": options.depth or None,
        "depth.refine_in_background": options.delivery == "newest" or None,
    }
    config = load_mapper_config(path, given, {"history.max_frames": options.history_frames})
    saved = before = None
    if options.map:
        file = map_path(Path(options.map))
        config = saved_map.stored_settings(config, path, options.voxel_size_m, file)
        saved = VoxelMap.load(file, config=config.voxel_map)
    mapper = Mapper.load(Path(options.weights) if options.weights else None, config)
    resumed = saved_map.resume_map(context, Path(options.out) / MAP_NAME, mapper.voxel_map)
    if saved is not None:
        before = visit_of(saved)
        saved_map.continue_map(mapper.voxel_map, saved, options.map)
    return mapper, resumed, before
