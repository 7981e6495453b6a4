"""The finetuner node: labelled keyframes in, better weights out, beside a mapper and within a budget."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import structlog

from semantic_mapper.backoff import backoff_s
from semantic_mapper.errors import FrameError, LabelError, WeightsError
from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import FinetunerOptions, NodeJob

if TYPE_CHECKING:
    from semantic_mapper.fields.checkpoint import Checkpoint
    from semantic_mapper.nodes.finetuner.finetune_round import LearningRound
    from semantic_mapper.nodes.finetuner.keyframe_store import LearningStore
    from semantic_mapper.training.online import Lesson, OnlineConfig
    from semantic_mapper.transport.messages import LabelledKeyframe, NodeState, WeightsInUse
    from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

POLL_S = 0.1
STATUS_PERIOD_S = 1.0
MAX_WAITING = 8  # keyframes, of about half a megabyte each, and of 64 MiB at the most
KEPT = 4  # weights that it can go on from, beside those that the mapper was started with
MAX_RETRY_S = 3600.0
GIVE_UP_S = 10.0  # that a round may take to end with the node
MAX_NICENESS = 19  # with it, learning has no more than what is left over
_COUNTERS = ("keyframes", "unusable", "set_aside", "rounds", "failed", "offered", "taken", "refused")

_log = structlog.get_logger(__name__)


def run_finetuner(context: NodeContext, options: FinetunerOptions) -> None:
    """Learn until somebody asks to stop.

    Raises:
        ConfigError, WeightsError: it cannot start.
        TransportError: an endpoint is taken.
    """
    _take_back_seat(options)
    from semantic_mapper.config import load_config
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint
    from semantic_mapper.memory import keep_freed_memory
    from semantic_mapper.training.online import OnlineConfig
    from semantic_mapper.transport.messages import digest_of
    from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

    keep_freed_memory()
    config = load_config(Path(options.config), OnlineConfig) if options.config else OnlineConfig()
    path = Path(options.weights) if options.weights else default_checkpoint_path()
    start, digest = load_checkpoint(path), digest_of(path.read_bytes())
    endpoint = options.labels if "://" in options.labels else context.endpoint(options.labels)
    with (
        Publisher(context.endpoint(context.name), hwm=2) as publisher,
        LosslessSubscriber(endpoint, ("keyframe",), hwm=MAX_WAITING) as labels,
        LosslessSubscriber(context.endpoint(options.mapper), ("in_use",)) as mapper,
    ):
        _log.info("ready", weights=path.name, labels=endpoint, share=options.share)
        node = _Finetuner(context, options, config, publisher, labels, mapper, start, digest)
        context.heartbeat.ready()
        node.run()
        context.heartbeat.ending()
        node.close()


def _take_back_seat(options: FinetunerOptions) -> None:
    """Before anything computes: threads that are started then inherit this."""
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    os.setpriority(os.PRIO_PROCESS, 0, max(options.niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    import torch

    torch.set_num_threads(options.threads)  # a forked process has read the variable before


@dataclass(frozen=True, slots=True)
class _Offer:
    """Weights that were published: version, digests of their file and of that of the weights before, and the round."""

    version: int
    digest: str
    parent: str
    lesson: Lesson


class _Finetuner:
    """State between two messages."""

    def __init__(
        self,
        context: NodeContext,
        options: FinetunerOptions,
        config: OnlineConfig,
        publisher: Publisher,
        labels: LosslessSubscriber,
        mapper: LosslessSubscriber,
        start: Checkpoint,
        digest: str,
    ) -> None:
        from semantic_mapper.nodes.finetuner.keyframe_store import FOLDER, LearningStore
        from semantic_mapper.training.keyframe_pool import KeyframePool

        self._context = context
        self._options = options
        self._config = config
        self._publisher = publisher
        self._labels = labels
        self._mapper = mapper
        self._start = digest
        self._known = {digest: start}  # by digest of their files
        self._pool = KeyframePool(start.label_set, held_out_every=config.held_out_every, capacity=config.max_keyframes)
        self._in_use: WeightsInUse | None = None
        self._round: LearningRound | None = None
        self._offer: _Offer | None = None  # until the mapper has judged it
        self._last_version = 0
        self._rolled_back = 0
        self._came_at = 0.0
        self._counts = dict.fromkeys(_COUNTERS, 0)
        self._refusal = ""
        self._failures = 0  # rounds, one after another
        self._failure = ""
        self._retry_at = 0.0
        self._store = LearningStore(Path(options.out) / FOLDER, start.label_set) if options.out else None
        self._store_failure = ""
        self._last_status = 0.0
        if self._store is not None:
            self._take_up(self._store)

    def run(self) -> None:
        """Handle messages and rounds until a stop request."""
        while not self._context.stop:
            self._context.heartbeat.turn()
            keyframe = self._labels.receive(POLL_S)
            if keyframe is not None:
                self._take(keyframe)  # pyright: ignore[reportArgumentType]
            while (in_use := self._mapper.receive(0.0)) is not None:
                self._follow(in_use)  # pyright: ignore[reportArgumentType]
            self._end_round()
            self._begin_round()
            self._keep()
            self._tell_status("running")

    def close(self) -> None:
        """Give up what is under way."""
        if self._round is not None:
            self._round.abandon()
            if not self._round.has_ended(GIVE_UP_S):
                _log.warning("round_left_behind", seconds=GIVE_UP_S, reason="it gets no processor")
            self._round = None
        self._keep()
        self._tell_status("ended", now=True)

    def _take_up(self, store: LearningStore) -> None:
        """Go on with what the process before this one had; a launch begins with nothing."""
        if not self._context.restarts:
            store.put_aside()
            return
        progress = store.restore(self._pool)
        self._rolled_back, self._failures = progress.rolled_back, progress.failures
        _log.info("taken_up", keyframes=len(self._pool), new=self._pool.new, failures=self._failures)
        if progress.learning:
            self._fail("the process before this one ended in the middle of a round")

    def _keep(self) -> None:
        from semantic_mapper.nodes.finetuner.keyframe_store import Progress

        if self._store is None:
            return
        learning = self._round is not None
        progress = Progress(rolled_back=self._rolled_back, failures=self._failures, learning=learning)
        try:
            self._store.keep(self._pool.kept, progress)
        except OSError as error:
            if str(error) != self._store_failure:
                _log.warning("not_kept", reason=str(error))
            self._store_failure = str(error)
        else:
            self._store_failure = ""

    def _take(self, keyframe: LabelledKeyframe) -> None:
        try:
            self._pool.add(keyframe.frame, keyframe.label_set)
        except (FrameError, LabelError) as error:
            self._counts["unusable"] += 1
            _log.warning("keyframe_refused", teacher=keyframe.teacher, reason=str(error))
            return
        self._counts["keyframes"] += 1
        self._came_at = time.monotonic()

    def _follow(self, in_use: WeightsInUse) -> None:
        """What the mapper uses decides what is learned from; what it has refused is not tried again."""
        before, self._in_use = self._in_use, in_use
        if in_use.rolled_back > self._rolled_back:
            forgotten = self._pool.return_to(in_use.version)
            self._counts["set_aside"] += forgotten
            _log.info("rolled_back", version=in_use.version, keyframes_set_aside=forgotten)
        self._rolled_back = in_use.rolled_back
        if self._round is not None and before is not None and before.digest != in_use.digest:
            self._round.abandon()
        offer = self._offer
        if offer is not None and in_use.judged == offer.version:
            self._offer = None
            if in_use.accepted and in_use.digest == offer.digest:
                self._know(in_use.digest, offer.lesson.checkpoint)
                self._pool.prove(offer.lesson.keys, offer.version)
                self._counts["taken"] += 1
                self._refusal = ""
            else:
                self._be_refused(offer, in_use)
        if in_use.digest not in self._known:
            self._find(in_use)

    def _be_refused(self, offer: _Offer, in_use: WeightsInUse) -> None:
        """By the mapper; labels are to blame only where what they taught contradicts the map."""
        reason = f"by the mapper: {in_use.reason}"
        if in_use.contradicts:
            self._refuse(offer.lesson, reason, worse=True)
            return
        self._counts["refused"] += 1
        self._refusal = reason
        if in_use.digest == offer.parent:  # otherwise they are tried at once with the weights in use now
            self._fail(reason)

    def _find(self, in_use: WeightsInUse) -> None:
        """The mapper has kept the weights that it was offered: those of a process before this one, or older ones."""
        from semantic_mapper.nodes.mapper.offered_weights import FOLDER, find_kept

        if not self._options.out:
            return
        try:
            found = find_kept(Path(self._options.out) / FOLDER, in_use.version, in_use.digest, self._known[self._start])
        except (WeightsError, OSError) as error:
            _log.warning("weights_not_found", version=in_use.version, reason=str(error))
            return
        if found is not None:
            self._know(in_use.digest, found)
            _log.info("weights_found", version=in_use.version, keyframes=len(found.anchors))

    def _know(self, digest: str, checkpoint: Checkpoint) -> None:
        self._known[digest] = checkpoint
        for old in [d for d in self._known if d not in (self._start, digest)][: -KEPT + 1]:
            del self._known[old]

    def _begin_round(self) -> None:
        from semantic_mapper.nodes.finetuner.finetune_round import LearningRound

        if self._round is not None or self._offer is not None or self._in_use is None:
            return
        if time.monotonic() < self._retry_at:
            return
        parent = self._known.get(self._in_use.digest)
        if parent is None or self._pool.new < self._config.new_keyframes:
            return
        lessons = self._pool.lessons()
        if len(lessons.train) < 2 or not lessons.held_out or time.monotonic() - self._came_at < self._options.settle_s:
            return
        _log.info("round_begins", keyframes=len(lessons.train), held_out=len(lessons.held_out))
        idle = self._options.niceness == MAX_NICENESS
        self._round = LearningRound(lessons, parent, self._in_use.digest, self._config, self._options.share, idle=idle)

    def _end_round(self) -> None:
        ended = self._round
        if ended is None or ended.running:
            return
        self._round = None
        if ended.lesson is None:
            if ended.abandoned:
                _log.info("round_given_up", reason=ended.failure)
            else:
                self._fail(ended.failure)
            return
        self._counts["rounds"] += 1
        self._failures, self._failure = 0, ""
        lesson = ended.lesson
        figures = {"score": round(lesson.score, 3), "parent_score": round(lesson.parent_score, 3)}
        _log.info("round_ends", **figures, seconds=round(ended.seconds, 1), rested_s=round(ended.rested_s, 1))
        if lesson.refusal:
            self._refuse(lesson, lesson.refusal, worse=lesson.worse)
        else:
            self._publish(lesson, ended.digest)

    def _publish(self, lesson: Lesson, parent: str) -> None:
        from semantic_mapper.nodes.finetuner.finetune_round import file_of
        from semantic_mapper.transport.codec import encode
        from semantic_mapper.transport.messages import WeightsUpdate, digest_of

        version = max(self._last_version, 0 if self._in_use is None else self._in_use.newest) + 1
        lesson.checkpoint.recipe.update(version=version, parent=parent, learner=self._context.name)
        data = file_of(lesson.checkpoint)
        update = WeightsUpdate(
            node=self._context.name,
            version=version,
            data=data,
            digest=digest_of(data),
            parent=parent,
            score=lesson.score,
            parent_score=lesson.parent_score,
            keyframes=len(lesson.checkpoint.anchors),
            held_out=len(lesson.keys) - len(lesson.checkpoint.anchors),
        )
        self._publisher.publish(encode(update))
        self._offer, self._last_version = _Offer(version, update.digest, parent, lesson), version
        self._counts["offered"] += 1
        _log.info("weights_offered", version=version, megabytes=round(len(data) / 1e6, 1))

    def _fail(self, why: str) -> None:
        """A round came to no end, which is no fault of the labels: they are kept, and tried again after a pause."""
        self._failures += 1
        self._counts["failed"] += 1
        pause_s = backoff_s(self._failures, self._options.retry_s, MAX_RETRY_S)
        self._retry_at = time.monotonic() + pause_s
        self._failure = why
        _log.warning("round_failed", reason=why, keyframes_kept=self._pool.new, next_in_s=pause_s)

    def _refuse(self, lesson: Lesson, why: str, *, worse: bool) -> None:
        """Labels that made the weights worse are forgotten: they would spoil every round to come."""
        forgotten = self._pool.set_aside(lesson.keys) if worse else self._pool.try_again(lesson.keys)
        self._counts["refused"] += 1
        self._counts["set_aside"] += forgotten
        self._refusal = why
        _log.warning("weights_rejected", reason=why, keyframes_set_aside=forgotten)

    def _tell_status(self, state: NodeState, *, now: bool = False) -> None:
        from semantic_mapper.transport.codec import encode
        from semantic_mapper.transport.messages import Status

        if not now and time.monotonic() - self._last_status < STATUS_PERIOD_S:
            return
        self._last_status = time.monotonic()
        counters = {**self._counts, "kept": len(self._pool), "new": self._pool.new, "rejected": self._labels.rejected}
        counters["learning"] = int(self._round is not None)
        counters["step"] = 0 if self._round is None else self._round.step
        degraded: tuple[str, ...] = ()
        if self._refusal:
            degraded = (f"the last weights were refused: {self._refusal}",)
        if self._failure:
            wait_s = max(0.0, self._retry_at - time.monotonic())
            degraded += (
                f"the last round failed ({self._failure}); its keyframes are kept, next try in {wait_s:.0f} s",
            )
        if self._store_failure:
            degraded += (f"keyframes would be lost with this process: {self._store_failure}",)
        if self._in_use is not None and self._in_use.digest not in self._known:
            degraded += (
                f"the mapper uses weights {self._in_use.version}, which this node does not know; start both with the "
                "same weights, or go back to weights that it knows",
            )
        status = Status(self._context.name, state, time.monotonic_ns(), counters, {}, degraded)
        self._publisher.publish(encode(status))


def main(job: NodeJob | None = None) -> NoReturn:
    """Run the node of this process to its end, then exit."""
    run_node(FinetunerOptions, run_finetuner, job)
