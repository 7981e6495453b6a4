"""The mapper node: frames in, map updates out; at the end of the stream it writes the map."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from nodes.node import NodeContext, run_node
from nodes.options import MapperOptions
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.memory import give_back_freed_memory

if TYPE_CHECKING:
    from nodes.autosave import Autosave
    from nodes.live_correction import LiveCorrection
    from nodes.query_service import QueryService
    from replay.session import MapSession, PipelineBundle
    from semantic_mapper.transport.messages import EndOfStream, NodeState, StreamInfo
    from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
    from semantic_mapper.types import PosedFrame

POLL_S = 0.1
STATUS_PERIOD_S = 1.0
HAND_OVER_S = 10.0  # for the whole map, before it is written: questions are answered meanwhile
TRIM_PERIOD_S = 60.0  # a node that runs for hours would otherwise hold more and more of what it has freed

_log = structlog.get_logger(__name__)


def run_mapper(context: NodeContext, options: MapperOptions) -> None:
    """Map until the stream ends or somebody asks to stop, then write the results.

    Raises:
        WeightsError, ConfigError: it cannot start.
        MapError: the map is full, or cannot be written.
        TransportError: an endpoint is taken.
    """
    from nodes.live_correction import LiveCorrection
    from nodes.outputs import prepare_folder
    from nodes.run_replay import mapper_config
    from replay.session import load_pipeline
    from semantic_mapper.fields.checkpoint import load_checkpoint
    from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher

    prepare_folder(Path(options.out))
    config = mapper_config(Path(options.config) if options.config else None, options.voxel_size_m or None)
    bundle = load_pipeline(Path(options.weights) if options.weights else None, config)
    correction = LiveCorrection(bundle.pipeline)
    exclude = load_checkpoint(Path(options.eval_exclude)).train_stamps_ns if options.eval_exclude else frozenset[int]()
    subscribe = LosslessSubscriber if options.delivery == "all" else NewestSubscriber
    with (
        Publisher(context.endpoint(context.name)) as publisher,
        subscribe(context.endpoint(options.input), ("info", "frame", "end")) as frames,
        _answering(context, options, bundle, correction) as queries,
    ):
        autosave = _saving(options, bundle)
        _log.info("ready", weights=bundle.weights_path.name, input=options.input, delivery=options.delivery)
        mapper = _Mapper(context, options, bundle, exclude, publisher, frames, queries, correction, autosave)
        try:
            mapper.run()
        except BaseException as error:
            frames.close()
            mapper.finish_after(error)
            raise
        frames.close()  # the camera waits until all have left
        mapper.finish()


def _answering(
    context: NodeContext, options: MapperOptions, bundle: PipelineBundle, correction: LiveCorrection
) -> QueryService | nullcontext[None]:
    """The query service, or nothing where none is wanted."""
    from nodes.query_service import QueryService

    if not options.query:
        return nullcontext()
    endpoint = options.query if "://" in options.query else context.endpoint(options.query)
    return QueryService(endpoint, bundle.pipeline.voxel_map, correction)


def _saving(options: MapperOptions, bundle: PipelineBundle) -> Autosave | None:
    from nodes.autosave import Autosave
    from nodes.saved_maps import MAP_NAME

    if not options.save_every_s:
        return None
    return Autosave(bundle.pipeline.voxel_map, Path(options.out) / MAP_NAME, options.save_every_s)


class _Mapper:
    """State between two messages."""

    def __init__(
        self,
        context: NodeContext,
        options: MapperOptions,
        bundle: PipelineBundle,
        exclude: frozenset[int],
        publisher: Publisher,
        frames: LosslessSubscriber | NewestSubscriber,
        queries: QueryService | None,
        correction: LiveCorrection,
        autosave: Autosave | None,
    ) -> None:
        self._context = context
        self._options = options
        self._bundle = bundle
        self._exclude = exclude
        self._publisher = publisher
        self._frames = frames
        self._queries = queries
        self._correction = correction
        self._autosave = autosave
        self._session: MapSession | None = None
        self._ended_by = "error"
        self._early = 0
        self._last_status = 0.0
        self._last_trim = time.monotonic()

    def run(self) -> None:
        """Handle messages until the end of the stream or a stop request."""
        from semantic_mapper.transport.messages import EndOfStream, StreamInfo
        from semantic_mapper.types import PosedFrame

        while not self._context.stop:
            message = self._frames.receive(0.0 if self._correction.running else POLL_S)
            match message:
                case StreamInfo():
                    self._begin(message)
                case PosedFrame():
                    self._map(message)
                case EndOfStream():
                    self._end(message)
                    return
                case _:
                    pass
            self._correction.carry_on(self._session, mapped=isinstance(message, PosedFrame))
            if self._queries is not None:
                self._queries.follow()
            if self._autosave is not None:
                self._autosave.follow()
            self._tell_status("running")
            if time.monotonic() - self._last_trim > TRIM_PERIOD_S:
                give_back_freed_memory()
                self._last_trim = time.monotonic()
        self._ended_by = self._context.stop.name

    def finish(self) -> None:
        """Write what there is."""
        from nodes.finishing import finish_session

        if self._session is None:
            _log.warning("nothing_to_write", reason="no stream has begun")
            return
        self._tell_status("stopping", now=True)
        if self._autosave is not None:
            self._autosave.close()
        self._correction.finish(self._session, lambda: bool(self._context.stop), self._while_stopping)
        if self._queries is not None and not self._queries.hand_over_all(HAND_OVER_S) and self._queries.asked:
            _log.warning("questions_lag_behind", reason=f"the map could not be handed over in {HAND_OVER_S:g} s")
        out = Path(self._options.out)
        summary = finish_session(self._session, out, self._ended_by)
        _log.info("map_written", out=str(out), **summary["frames"])
        self._tell_status("ended", now=True)

    def _while_stopping(self) -> None:
        self._tell_status("stopping")
        if self._queries is not None:
            self._queries.follow()

    def finish_after(self, error: BaseException) -> None:
        """Write what there is, and let no second failure hide the first."""
        try:
            self.finish()
        except (SemanticMapperError, OSError) as second:
            _log.error("results_not_written", reason=str(second), after=str(error))

    def _begin(self, info: StreamInfo) -> None:
        from nodes.run_replay import clear_summary
        from replay.session import MapSession

        if self._session is not None:  # the same stream, told again to a newcomer
            return
        clear_summary(Path(self._options.out))
        self._session = MapSession(
            self._bundle,
            stream_labels=info.label_set,
            exclude_stamps=self._exclude,
            source=info.source,
            rerun=Path(self._options.rerun) if self._options.rerun else None,
        )
        _log.info("stream_begins", source=info.source, frames=info.frame_count)

    def _map(self, frame: PosedFrame) -> None:
        from semantic_mapper.transport.codec import encode_map_update, encode_refused
        from semantic_mapper.transport.messages import FrameRefused

        if self._session is None:
            self._early += 1
            _log.warning("frame_before_stream_info", seq=frame.seq)
            return
        update = self._session.process(frame)
        if update is None:
            reason = self._session.refusals.last.reason
            refused = FrameRefused(frame.stamp_ns, frame.seq, frame.camera_id, reason)
            self._publisher.publish(encode_refused(refused))
        else:
            self._publisher.publish(encode_map_update(update))

    def _end(self, end: EndOfStream) -> None:
        self._ended_by = "" if end.reason == "end" else f"{end.source}: {end.detail or end.reason}"
        if self._session is not None:
            self._session.count_dropped(max(0, end.published - self._session.published))
            for damage in end.damages:
                self._session.note_damage(damage)
        _log.info("stream_ends", reason=end.reason, published=end.published, detail=end.detail)

    def _tell_status(self, state: NodeState, *, now: bool = False) -> None:
        from semantic_mapper.transport.codec import encode_status
        from semantic_mapper.transport.messages import Status

        if not now and time.monotonic() - self._last_status < STATUS_PERIOD_S:
            return
        self._last_status = time.monotonic()
        counters = {"rejected": self._frames.rejected, "early": self._early}
        if self._session is not None:
            s = self._session
            counters |= {"published": s.published, "fused": s.fused, "refused": len(s.refusals), "dropped": s.dropped}
        silent = self._frames.silent_s
        ages = {} if silent is None else {"frame": silent}
        counters |= self._correction.counters
        degraded = self._correction.degraded
        if self._queries is not None:
            counters |= {"answered": self._queries.answered, "abandoned": self._queries.abandoned}
            if not self._queries.alive:
                degraded += ("questions about the map are no longer answered; see the log",)
        if self._autosave is not None:
            counters["saves"] = self._autosave.saves
            if self._autosave.failure:
                degraded += (f"the map was not saved: {self._autosave.failure}",)
        status = Status(self._context.name, state, time.monotonic_ns(), counters, ages, degraded)
        self._publisher.publish(encode_status(status))


if __name__ == "__main__":
    run_node(MapperOptions, run_mapper)
