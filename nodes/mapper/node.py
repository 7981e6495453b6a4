"""The mapper node: frames in, map updates out; at the end of the stream it writes the map."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import structlog

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.memory import give_back_freed_memory
from semantic_mapper.nodes.frame_gaps import Gaps
from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import MapperOptions, NodeJob
from semantic_mapper.nodes.streams import Streams

if TYPE_CHECKING:
    from semantic_mapper.mapper import Mapper
    from semantic_mapper.nodes.mapper.autosave import Autosave
    from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
    from semantic_mapper.nodes.mapper.live_weights import LiveWeights
    from semantic_mapper.nodes.mapper.query_service import QueryService
    from semantic_mapper.replay.session import MapSession
    from semantic_mapper.transport.messages import EndOfStream, NodeState, StreamInfo
    from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
    from semantic_mapper.types import PosedFrame

POLL_S = 0.1
STATUS_PERIOD_S = 1.0
HAND_OVER_S = 10.0  # for the whole map, before it is written: questions are answered meanwhile
MAX_AGE_S = 60.0  # of a frame, by its stamp: more, or less than nothing, and its clock is not this machine's
TRIM_PERIOD_S = 60.0  # a node that runs for hours would otherwise hold more and more of what it has freed

_log = structlog.get_logger(__name__)


def run_mapper(context: NodeContext, options: MapperOptions) -> None:
    """Map until the stream ends or somebody asks to stop, then write the results.

    Raises:
        WeightsError, ConfigError: it cannot start.
        MapError: the map is full, or cannot be written.
        TransportError: an endpoint is taken.
    """
    from semantic_mapper.fields.checkpoint import load_checkpoint
    from semantic_mapper.mapper import Mapper
    from semantic_mapper.mapping.voxel_map import VoxelMap
    from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
    from semantic_mapper.nodes.mapper.live_weights import taking_weights
    from semantic_mapper.nodes.mapper.resume import go_on, stored_settings, take_up
    from semantic_mapper.nodes.public_publisher import PublicPublisher
    from semantic_mapper.replay.run_folder import MAP_NAME, map_path, prepare_folder
    from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber

    prepare_folder(Path(options.out))
    config = load_mapper_config(
        Path(options.config) if options.config else None,
        {
            "voxel_map.voxel_size_m": options.voxel_size_m or None,
            "depth.source": options.depth or None,
            "depth.refine_in_background": options.delivery == "newest" or None,
        },
        {"history.max_frames": options.history_frames},
    )
    saved = None
    if options.map:
        config = stored_settings(config, _given(options), map_path(Path(options.map)))
        saved = VoxelMap.load(map_path(Path(options.map)), config=config.voxel_map)
    bundle = Mapper.load(Path(options.weights) if options.weights else None, config)
    taken_up = take_up(context, Path(options.out) / MAP_NAME, bundle.pipeline.voxel_map)
    if saved is not None:
        go_on(bundle.pipeline.voxel_map, saved, options.map)
    correction = LiveCorrection(bundle.pipeline)
    exclude = load_checkpoint(Path(options.eval_exclude)).train_stamps_ns if options.eval_exclude else frozenset[int]()
    subscribe = LosslessSubscriber if options.delivery == "all" else NewestSubscriber
    with (
        PublicPublisher(context.endpoint(context.name), options.publish, options.keys) as publisher,
        subscribe([context.endpoint(name) for name in options.cameras], ("info", "frame", "end")) as frames,
        taking_weights(context, options, bundle, publisher) as weights,
        _answering(context, options, bundle, correction, weights) as queries,
    ):
        autosave = _saving(options, bundle)
        _log.info(
            "ready", weights=bundle.weights_path.name, input=", ".join(options.cameras), delivery=options.delivery
        )
        parts = (queries, correction, weights, autosave)
        mapper = _Mapper(context, options, bundle, exclude, publisher, frames, *parts, taken_up)
        context.heartbeat.ready()
        try:
            mapper.run()
        except BaseException as error:
            frames.close()
            mapper.finish_after(error)
            raise
        context.heartbeat.ending()
        frames.close()  # the camera waits until all have left
        mapper.finish()


def _given(options: MapperOptions) -> set[str]:
    """Names in ``voxel_map`` that the user has set."""
    from semantic_mapper.config import read_toml

    told = read_toml(Path(options.config)) if options.config else {}
    return {*told.get("voxel_map", {}), *(("voxel_size_m",) if options.voxel_size_m else ())}


def _answering(
    context: NodeContext,
    options: MapperOptions,
    bundle: Mapper,
    correction: LiveCorrection,
    weights: LiveWeights | None,
) -> QueryService | nullcontext[None]:
    """The query service, or nothing where none is wanted."""
    from semantic_mapper.nodes.mapper.query_service import QueryService
    from semantic_mapper.transport.keys import load_keys

    if not options.query:
        return nullcontext()
    endpoint = options.query if "://" in options.query else context.endpoint(options.query)
    keys = load_keys(Path(options.keys).expanduser()) if options.keys else None
    pipeline = bundle.pipeline
    return QueryService(
        endpoint, pipeline.voxel_map, correction, keys, weights, pipeline.moving.space, pipeline.whereabouts
    )


def _saving(options: MapperOptions, bundle: Mapper) -> Autosave | None:
    from semantic_mapper.nodes.mapper.autosave import Autosave
    from semantic_mapper.replay.run_folder import MAP_NAME

    if not options.save_every_s:
        return None
    return Autosave(bundle.pipeline.voxel_map, Path(options.out) / MAP_NAME, options.save_every_s)


class _Mapper:
    """State between two messages."""

    def __init__(
        self,
        context: NodeContext,
        options: MapperOptions,
        bundle: Mapper,
        exclude: frozenset[int],
        publisher: Publisher,
        frames: LosslessSubscriber | NewestSubscriber,
        queries: QueryService | None,
        correction: LiveCorrection,
        weights: LiveWeights | None,
        autosave: Autosave | None,
        taken_up: str,
    ) -> None:
        self._context = context
        self._options = options
        self._bundle = bundle
        self._exclude = exclude
        self._publisher = publisher
        self._frames = frames
        self._queries = queries
        self._correction = correction
        self._weights = weights
        self._autosave = autosave
        self._taken_up = taken_up  # see ``resuming.take_up``
        self._session: MapSession | None = None
        self._streams = Streams(len(options.cameras))
        self._gaps = Gaps()
        self._broken = context.restarts > 0  # the camera or the mapper was not there all the time
        self._corrected = False
        self._step_us = 0  # that all steps took
        self._capture_age_s: float | None = None
        self._ended_by = "error"
        self._early = 0
        self._last_status = 0.0
        self._last_trim = time.monotonic()

    def run(self) -> None:
        """Handle messages until the end of the stream or a stop request."""
        from semantic_mapper.transport.messages import EndOfStream, StreamInfo
        from semantic_mapper.types import PosedFrame

        while not self._context.stop:
            self._context.heartbeat.turn()
            message = self._frames.receive(0.0 if self._correction.running else POLL_S)
            match message:
                case StreamInfo():
                    self._begin(message)
                case PosedFrame():
                    self._map(message)
                case EndOfStream():
                    if self._end(message):
                        return
                case _:
                    self._forget_what_moves()
            self._note_correction()
            self._correction.carry_on(self._session, mapped=isinstance(message, PosedFrame))
            if self._weights is not None:
                self._weights.carry_on(self._session, mapped=isinstance(message, PosedFrame))
            if self._queries is not None:
                self._queries.follow()
            if self._autosave is not None:
                self._autosave.follow()
            self._publish_status("running")
            if time.monotonic() - self._last_trim > TRIM_PERIOD_S:
                give_back_freed_memory()
                self._last_trim = time.monotonic()
        self._ended_by = self._context.stop.name

    def _forget_what_moves(self) -> None:
        """Where frames have ceased, nothing is known any more of where what moves is."""
        from semantic_mapper.mapping.moving import KEPT_S

        silent_s = self._frames.silent_s
        if silent_s is not None and silent_s > KEPT_S:
            self._bundle.pipeline.moving.space.clear()

    def finish(self) -> None:
        """Write what there is."""
        from semantic_mapper.replay.artifacts import finish_session
        from semantic_mapper.replay.session import MapSession

        if self._session is None:
            if not self._bundle.pipeline.voxel_map.frames:
                _log.warning("nothing_to_write", reason="no stream has begun")
                return
            self._session = MapSession(self._bundle, stream_labels=None)  # of the map that was saved before a restart
        self._publish_status("stopping", now=True)
        if self._autosave is not None:
            self._autosave.close()
        self._correction.finish(self._session, lambda: bool(self._context.stop), self._while_stopping)
        if self._queries is not None and not self._queries.hand_over_all(HAND_OVER_S) and self._queries.asked:
            _log.warning("questions_lag_behind", reason=f"the map could not be handed over in {HAND_OVER_S:g} s")
        if self._weights is not None:
            self._session.learned = self._weights.close()
        out = Path(self._options.out)
        summary = finish_session(self._session, out, self._ended_by, self._taken_up, self._step_of_finish)
        _log.info("map_written", out=str(out), **summary["frames"])
        self._publish_status("ended", now=True)

    def _step_of_finish(self) -> None:
        self._context.heartbeat.turn()
        self._publish_status("stopping")

    def _while_stopping(self) -> None:
        self._step_of_finish()
        if self._queries is not None:
            self._queries.follow()

    def _note_correction(self) -> None:
        """Frames after a correction may still come in the world before it: a restarted mapper could not tell."""
        if not self._corrected and self._bundle.pipeline.corrector.status.poses:
            from semantic_mapper.nodes.mapper.resume import forbid

            self._corrected = True
            noted = forbid(self._context, "poses had been corrected, which only the mapper that was killed knew of")
            if not noted and self._autosave is not None:
                self._autosave.end("poses were corrected, and no note could say so to a mapper that replaces this one")

    def finish_after(self, error: BaseException) -> None:
        """Write what there is, and let no second failure hide the first."""
        try:
            self.finish()
        except (SemanticMapperError, OSError) as second:
            _log.error("results_not_written", reason=str(second), after=str(error))

    def _begin(self, info: StreamInfo) -> None:
        from semantic_mapper.nodes.mapper.resume import keep_earlier, noted_worlds
        from semantic_mapper.replay.artifacts import clear_results
        from semantic_mapper.replay.run_folder import MAP_NAME
        from semantic_mapper.replay.session import MapSession, open_recording

        # A stream is announced again to a newcomer, or by a restarted camera; or another camera begins.
        self._broken |= self._streams.begin(info)
        self._bundle.pipeline.voxel_map.note_scale(info.scale_known)  # of further streams, too
        if self._session is not None:
            self._session.source = self._streams.source
            return
        out = Path(self._options.out)
        if self._options.delivery == "newest":
            keep_earlier(self._context, out / MAP_NAME)
        clear_results(out)
        self._session = MapSession(
            self._bundle,
            stream_labels=info.label_set,
            exclude_stamps=self._exclude,
            source=info.source,
            rerun=open_recording(Path(self._options.rerun) if self._options.rerun else None, self._bundle.pipeline),
            own_first=not self._options.map,
        )
        if self._bundle.pipeline.voxel_map.frames:
            self._session.worlds.known.update(noted_worlds(self._context))
        _log.info("stream_begins", source=info.source, frames=info.frame_count)

    def _map(self, frame: PosedFrame) -> None:
        from semantic_mapper.nodes.mapper.resume import note_worlds
        from semantic_mapper.transport.codec import encode
        from semantic_mapper.transport.messages import FrameRefused
        from semantic_mapper.types import MapUpdate

        if self._session is None:
            self._early += 1
            _log.warning("frame_before_stream_info", seq=frame.seq)
            return
        self._gaps.note(frame.camera_id, frame.seq)
        self._streams.note_frame(frame.camera_id)
        before = len(self._session.worlds.known)
        results = self._session.process(frame)
        if len(self._session.worlds.known) != before:
            note_worlds(self._context, self._session.worlds.known)
        if not results and self._session.worlds.held:  # a player in lockstep waits for an answer to every frame
            refused = FrameRefused(frame.stamp_ns, frame.seq, frame.camera_id, self._session.worlds.warning)
            self._publisher.publish(encode(refused))
        self._capture_age_s = (time.monotonic_ns() - frame.stamp_ns) / 1e9
        for result in results:
            if isinstance(result, MapUpdate):
                self._step_us += round(1e3 * sum(result.stage_ms.values()))
                self._publisher.publish(encode(result))
            else:
                refused = FrameRefused(result.stamp_ns, result.seq, result.camera_id, result.reason)
                self._publisher.publish(encode(refused))

    def _end(self, end: EndOfStream) -> bool:
        """One stream has ended; True where all have."""
        if self._streams.knows(end):
            return False
        if self._session is not None:
            for damage in end.damages:
                self._session.note_damage(damage)
            if end.unreadable:
                self._session.refuse_unreadable(end.unreadable, end.damages)
        _log.info("stream_ends", reason=end.reason, published=end.published, detail=end.detail)
        if not self._streams.end(end):
            return False
        self._ended_by = self._streams.ended_by
        if self._session is not None:
            broken = self._broken or self._gaps.begun_anew > 0  # then the camera has not counted all that we have had
            missed = self._gaps.missed if broken else max(0, self._streams.published - self._session.received)
            self._session.count_dropped(missed)
        return True

    def _publish_status(self, state: NodeState, *, now: bool = False) -> None:
        from semantic_mapper.mapping.map_scale import MEND
        from semantic_mapper.nodes.status import publish_status
        from semantic_mapper.transport.messages import Status

        if not now and time.monotonic() - self._last_status < STATUS_PERIOD_S:
            return
        self._last_status = time.monotonic()
        counters = {"rejected": self._frames.rejected, "early": self._early, "missed": self._gaps.missed}
        if self._session is not None:
            s = self._session
            counters |= {"published": s.published, "fused": s.fused, "refused": len(s.refusals), "dropped": s.dropped}
            counters |= {"cleared": s.pipeline.voxel_map.cleared, "moving": s.pipeline.moving.pixels}
            counters["step_us"] = self._step_us
        silent = self._frames.silent_s
        ages = self._streams.ages_s | ({} if silent is None else {"frame": silent})
        if self._capture_age_s is not None and 0 <= self._capture_age_s < MAX_AGE_S:
            ages["capture"] = self._capture_age_s
        counters |= self._correction.counters
        degraded = self._correction.degraded
        if self._session is not None:
            worlds = self._session.worlds
            counters |= {"held": worlds.held, "relocalized": worlds.found, "not_found": worlds.refused.total()}
            degraded += (worlds.warning,) if worlds.warning else ()
        if self._weights is not None:
            counters |= self._weights.counters
            degraded += self._weights.degraded
        if self._taken_up:
            degraded += (self._taken_up,)
        if not self._bundle.pipeline.voxel_map.scale_known:
            degraded += (f"scale: unknown; lengths of the map are not metres: {MEND}",)
        pictures = self._bundle.pipeline.picture_check
        counters |= pictures.counters
        degraded += pictures.warnings
        degraded += tuple(
            w for w in (self._bundle.pipeline.pose_check.warning, self._bundle.pipeline.moving.warning) if w
        )
        if self._queries is not None:
            counters |= {"answered": self._queries.answered, "abandoned": self._queries.abandoned}
            if not self._queries.alive:
                degraded += ("questions about the map are no longer answered; see the log",)
        if self._autosave is not None:
            counters["saves"] = self._autosave.saves
            if self._autosave.failure:
                degraded += (f"the map was not saved: {self._autosave.failure}",)
        status = Status(self._context.name, state, time.monotonic_ns(), counters, ages, degraded)
        publish_status(self._publisher, status)


def main(job: NodeJob | None = None) -> NoReturn:
    """Run the node of this process to its end, then exit."""
    run_node(MapperOptions, run_mapper, job)
