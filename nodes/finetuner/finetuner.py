"""Labelled keyframes in, better weights out: the finetuner next to a mapper, between two messages."""

import threading
import time
from concurrent.futures import CancelledError
from pathlib import Path

import structlog
import torch

from semantic_mapper.config import load_config
from semantic_mapper.errors import CodecError, FrameError, LabelError, SemanticMapperError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, build_checkpoint, checkpoint_bytes, load_checkpoint
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.finetuner.keyframe_store import FOLDER, LearningStore, Progress
from semantic_mapper.nodes.mapper.offered_weights import FOLDER as WEIGHTS_FOLDER
from semantic_mapper.nodes.mapper.offered_weights import read_kept
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import FinetunerOptions
from semantic_mapper.nodes.process import run_when_idle
from semantic_mapper.nodes.publishing import PartStatus, StatusReport
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.online import KeyframePool, KeyframeSplit, OnlineResult, learn
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import LabelledKeyframe, WeightsInUse, WeightsUpdate, digest_of
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

MAX_WAITING = 8  # keyframes, of about half a megabyte each, and of 64 MiB at the most
POLL_S = 0.1
SETTLE_S = 2.0  # no keyframe for so long, and those that came are learned: people and tools send several at a time
# After a round that failed for want of memory, say: pause before the next with the same keyframes, twice as long with
# each further one in a row.
RETRY_S = 20.0
MAX_RETRY_S = 3600.0
NEW_KEYFRAMES = 4  # this many must have come since the last round: fewer teach little for what a round costs
HELD_OUT_EVERY = 4  # of this many keyframes, the last is never learned from: it judges
MAX_KEYFRAMES = 32  # kept; past it the oldest goes, so that memory and a round's time are bounded
GIVE_UP_S = 10.0  # that a round may take to end with the node
MAX_NICENESS = 19  # with it, learning gets only what is left over of the processors
_COUNTERS = ("keyframes", "unusable", "set_aside", "rounds", "failed", "offered", "taken", "refused")

_log = structlog.get_logger(__name__)


def run_finetuner(context: NodeContext, options: FinetunerOptions) -> None:
    """Open the sockets, load the weights to start from, and learn until a stop request."""
    keep_freed_memory()
    endpoint = context.endpoint(options.labels)
    with (
        Publisher(context.endpoint(context.name), hwm=2) as publisher,
        LosslessSubscriber(endpoint, ("keyframe",), hwm=MAX_WAITING) as labels,
        LosslessSubscriber(context.endpoint(options.mapper), ("in_use",)) as mapper,
    ):
        finetuner = Finetuner(context, options, publisher, labels, mapper)
        _log.info("ready", labels=endpoint, fraction=options.cpu_fraction)
        context.heartbeat.ready()
        finetuner.run()
        context.heartbeat.ending()
        finetuner.close()


class FinetuneRound:
    """A round of learning in a ``thread`` of its own, which rests after each step and each look as its share says.

    Once ``cancelled`` is set it ends after the step that it is in, and nobody wants its outcome any more. ``parent`` is
    in use; ``fraction`` is of a core, or of the GPU; where ``idle``, it learns only while nobody else wants the core.
    """

    def __init__(
        self,
        keyframes: KeyframeSplit,
        parent: Checkpoint,
        parent_digest: str,
        config: OnlineConfig,
        fraction: float,
        *,
        idle: bool,
    ) -> None:
        self.parent_digest = parent_digest
        self.step = 0
        self.result: OnlineResult | None = None
        self.failure = "it failed; see the log"
        self.cancelled = threading.Event()
        self._fraction = fraction
        self._clock = time.process_time if config.finetune.device == "cpu" else time.monotonic
        self._worked_from = self._clock()
        run = (keyframes, parent, config, idle)
        self.thread = threading.Thread(target=self._run, args=run, name="learning", daemon=True)
        self.thread.start()

    def _run(self, keyframes: KeyframeSplit, parent: Checkpoint, config: OnlineConfig, idle: bool) -> None:
        torch.set_num_threads(torch.get_num_threads())  # OpenMP has a limit for each thread
        if idle:
            run_when_idle()
        try:
            self.result = learn(keyframes, parent, config, self._on_progress, self._rest)
        except CancelledError:
            _log.info("round_given_up", reason="the mapper uses other weights now")
        except SemanticMapperError as error:
            self.failure = str(error)
        except (MemoryError, RuntimeError) as error:  # torch raises a RuntimeError where memory is exhausted
            first, _, _ = str(error).strip().partition("\n")
            self.failure = f"{type(error).__name__}: {first}"

    def _on_progress(self, progress: FitProgress) -> None:
        self.step = progress.step
        self._rest()

    def _rest(self) -> None:
        worked_s = self._clock() - self._worked_from
        if self.cancelled.wait(worked_s / self._fraction - worked_s):
            raise CancelledError
        self._worked_from = self._clock()


class Finetuner:
    """Learns from labelled keyframes, and offers the mapper what proves better."""

    def __init__(
        self,
        context: NodeContext,
        options: FinetunerOptions,
        publisher: Publisher,
        labels: LosslessSubscriber,
        mapper: LosslessSubscriber,
    ) -> None:
        self.context, self.options = context, options
        self.publisher, self.labels, self.mapper = publisher, labels, mapper
        self.config = load_config(Path(options.config), OnlineConfig) if options.config else OnlineConfig()
        path = Path(options.weights) if options.weights else default_checkpoint_path()
        start = self.start = load_checkpoint(path)  # what the mapper was started with
        self.start_digest = digest_of(path.read_bytes())
        self._report = StatusReport(context.name, publisher)
        self._pool = KeyframePool(start.label_set, held_out_every=HELD_OUT_EVERY, capacity=MAX_KEYFRAMES)
        self._last_keyframe_s = 0.0
        self._in_use: WeightsInUse | None = None
        self._current: Checkpoint | None = None  # the weights in use; None = unknown
        self._round: FinetuneRound | None = None
        self._offer: tuple[WeightsUpdate, OnlineResult] | None = None  # until the mapper has answered
        self._last_version = 0
        self._counts = dict.fromkeys(_COUNTERS, 0)
        self._refusal = ""  # why the last weights were refused
        self._failure = ""  # why the last round failed
        self._failures = 0  # in a row
        self._retry_at_s = 0.0
        self._store = LearningStore(Path(options.out) / FOLDER, start.label_set) if options.out else None
        self._store_failure = ""
        if self._store is not None:
            self._restore(self._store)

    def run(self) -> None:
        """Handle messages and rounds until a stop request."""
        while not self.context.stop:
            self.context.heartbeat.turn()
            if isinstance(keyframe := self.labels.receive(POLL_S), LabelledKeyframe):
                self._add(keyframe)
            while isinstance(in_use := self.mapper.receive(0.0), WeightsInUse):
                self._follow(in_use)
            self._end_round()
            self._begin_round()
            self._save()
            if self._report.due:
                self._report.publish("running", self._status())

    def close(self) -> None:
        """Cancel the round that runs."""
        if self._round is not None:
            self._round.cancelled.set()
            self._round.thread.join(GIVE_UP_S)
            if self._round.thread.is_alive():
                _log.warning("round_left_behind", seconds=GIVE_UP_S, reason="it gets no processor")
            self._round = None
        self._save()
        self._report.publish("ended", self._status())

    def _restore(self, store: LearningStore) -> None:
        """After a restart, go on with the keyframes of the process before; a launch begins with none."""
        if not self.context.restarts:
            store.put_aside()
            return
        progress = store.restore(self._pool)
        self._failures = progress.failures
        _log.info("taken_up", keyframes=len(self._pool), new=self._pool.new, failures=self._failures)
        if progress.learning:
            self._fail("the process before this one ended in the middle of a round")

    def _save(self) -> None:
        if self._store is None:
            return
        progress = Progress(failures=self._failures, learning=self._round is not None)
        try:
            self._store.keep(self._pool.kept, progress)
            self._store_failure = ""
        except OSError as error:
            if str(error) != self._store_failure:
                _log.warning("not_kept", reason=str(error))
            self._store_failure = str(error)

    def _add(self, keyframe: LabelledKeyframe) -> None:
        try:
            self._pool.add(keyframe.frame, keyframe.label_set)
        except (FrameError, LabelError) as error:
            self._counts["unusable"] += 1
            _log.warning("keyframe_refused", teacher=keyframe.teacher, reason=str(error))
            return
        self._counts["keyframes"] += 1
        self._last_keyframe_s = time.monotonic()

    def _follow(self, in_use: WeightsInUse) -> None:
        """Go on from the weights that the mapper uses now."""
        before, self._in_use = self._in_use, in_use
        changed = before is None or before.digest != in_use.digest
        if changed or self._current is None:
            self._current = self._find(in_use)
        if changed and self._round is not None:
            self._round.cancelled.set()
        if self._offer is not None and in_use.judged == self._offer[0].version:
            self._take_answer(*self._offer, in_use)
            self._offer = None

    def _find(self, in_use: WeightsInUse) -> Checkpoint | None:
        """The weights in use: those of the start, those offered, or those that the mapper keeps in ``out``."""
        if in_use.digest == self.start_digest:
            return self.start
        if self._offer is not None and in_use.digest == self._offer[0].digest:
            return self._offer[1].checkpoint
        if not self.options.out:
            return None
        folder = Path(self.options.out) / WEIGHTS_FOLDER
        try:
            found = build_checkpoint(read_kept(folder, in_use.version, in_use.digest, self.start.weights))
        except (WeightsError, OSError) as error:
            _log.warning("weights_not_found", version=in_use.version, reason=str(error))
            return None
        _log.info("weights_found", version=in_use.version, keyframes=len(found.anchors))
        return found

    def _take_answer(self, update: WeightsUpdate, result: OnlineResult, in_use: WeightsInUse) -> None:
        """The mapper's answer to an offer. Labels are to blame only where they contradict its map."""
        reason = f"by the mapper: {in_use.reason}"
        if in_use.accepted and in_use.digest == update.digest:
            self._pool.validate(result.keys)
            self._counts["taken"] += 1
            self._refusal = ""
        elif in_use.contradicts:
            self._reject(result, reason, worse=True)
        else:
            self._counts["refused"] += 1
            self._refusal = reason
            if in_use.digest == update.parent:  # otherwise they are tried at once with the weights in use now
                self._fail(reason)

    def _begin_round(self) -> None:
        if self._round is not None or self._offer is not None or self._in_use is None or self._current is None:
            return
        now_s = time.monotonic()
        if now_s < self._retry_at_s or now_s - self._last_keyframe_s < SETTLE_S:
            return
        keyframes = self._pool.split()
        if self._pool.new < NEW_KEYFRAMES or len(keyframes.train) < 2 or not keyframes.held_out:
            return
        _log.info("round_begins", keyframes=len(keyframes.train), held_out=len(keyframes.held_out))
        idle, parent = self.options.niceness == MAX_NICENESS, self._in_use.digest
        fraction = self.options.cpu_fraction
        self._round = FinetuneRound(keyframes, self._current, parent, self.config, fraction, idle=idle)

    def _end_round(self) -> None:
        ended = self._round
        if ended is None or ended.thread.is_alive():
            return
        self._round = None
        if ended.cancelled.is_set():
            return
        if (result := ended.result) is None:
            self._fail(ended.failure)
            return
        self._counts["rounds"] += 1
        self._failures, self._failure = 0, ""
        _log.info("round_ends", score=round(result.score, 3), parent_score=round(result.parent_score, 3))
        if result.refusal:
            self._reject(result, result.refusal, worse=result.worse)
        else:
            self._publish(result, ended.parent_digest)

    def _publish(self, result: OnlineResult, parent: str) -> None:
        name, checkpoint, learned = self.context.name, result.checkpoint, len(result.checkpoint.anchors)
        self._last_version = max(self._last_version, 0 if self._in_use is None else self._in_use.newest) + 1
        checkpoint.recipe.update(version=self._last_version, parent=parent, learner=name)
        data = checkpoint_bytes(checkpoint)
        judged = (result.score, result.parent_score, learned, len(result.keys) - learned)
        update = WeightsUpdate(name, self._last_version, data, digest_of(data), parent, *judged)
        try:
            parts = encode(update)
        except CodecError as error:  # numbers of versions are the mapper's, who may have been offered any
            self._fail(f"the weights cannot be sent: {error}")
            return
        self.publisher.publish(parts)
        self._offer = update, result
        self._counts["offered"] += 1
        _log.info("weights_offered", version=update.version, megabytes=round(len(data) / 1e6, 1))

    def _fail(self, reason: str) -> None:
        """A round failed through no fault of the labels: they are kept, and tried again after a pause."""
        self._failures += 1
        pause_s = min(RETRY_S * 2.0 ** min(self._failures - 1, 64), MAX_RETRY_S)
        self._retry_at_s = time.monotonic() + pause_s
        self._counts["failed"] += 1
        self._failure = reason
        _log.warning("round_failed", reason=reason, keyframes_kept=self._pool.new, next_in_s=pause_s)

    def _reject(self, result: OnlineResult, reason: str, *, worse: bool) -> None:
        """Keyframes that made the weights worse are dropped: they would spoil every round to come."""
        dropped = self._pool.reject(result.keys, worse=worse)
        self._counts["refused"] += 1
        self._counts["set_aside"] += dropped
        self._refusal = reason
        _log.warning("weights_rejected", reason=reason, keyframes_set_aside=dropped)

    def _status(self) -> PartStatus:
        running = self._round
        counters = {**self._counts, "kept": len(self._pool), "new": self._pool.new, "rejected": self.labels.rejected}
        counters |= {"learning": int(running is not None), "step": 0 if running is None else running.step}
        warnings = [f"the last weights were refused: {self._refusal}"] if self._refusal else []
        if self._failure:
            wait = f"next try in {max(0.0, self._retry_at_s - time.monotonic()):.0f} s"
            warnings.append(f"the last round failed ({self._failure}); its keyframes are kept, {wait}")
        if self._store_failure:
            warnings.append(f"keyframes would be lost with this process: {self._store_failure}")
        if self._in_use is not None and self._current is None:
            warnings.append(
                f"the mapper uses weights {self._in_use.version}, which this node does not know; start both with the "
                "same weights"
            )
        return PartStatus(counters, tuple(warnings))
