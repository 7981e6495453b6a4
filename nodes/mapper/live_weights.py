"""Weights that reach a mapper while it maps: looked at beside it, compared with its map, taken between two frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
from msgspec import to_builtins

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.views.weights_check import FieldTrial
from semantic_mapper.nodes.mapper.offered_weights import (
    FOLDER,
    OfferedWeights,
    file_of_version,
    read_offer,
    read_weights,
)
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import MapperOptions
from semantic_mapper.replay.session import MapSession
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import WeightsInUse, WeightsUpdate, digest_of
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

COMPARED = 4  # frames of the session, well spread, in which new weights are compared with the map
MAX_PAUSE_S = 5.0  # the first look may compile
MAX_SHARE = 0.1  # of the mapper's time that looking at new weights may take; the pause after a dear look is longer
KEPT = 8  # versions whose files are kept, beside those that the mapper was started with
LISTED = 64  # versions that are told of
_WAITING = 2  # offers, of some 20 MB each
_NOTE = "weights"  # for the process that takes over when this one is killed

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Task:
    """Weights on their way into use; ``trial`` once they have been read."""

    version: OfferedWeights
    reading: Future[Checkpoint]
    is_return: bool = False
    trial: FieldTrial | None = None


@contextmanager
def taking_weights(
    context: NodeContext, options: MapperOptions, bundle: Mapper, publisher: Publisher
) -> Iterator[LiveWeights | None]:
    """What takes the weights of the learner that ``options`` name; None where they name none.

    Raises:
        TransportError: no endpoint.
    """
    if not options.learner:
        yield None
        return
    with LosslessSubscriber(context.endpoint(options.learner), ("weights",), hwm=_WAITING) as offers:
        weights = LiveWeights(context, bundle, Path(options.out) / FOLDER, options.least_agreement, publisher, offers)
        try:
            yield weights
        finally:
            weights.close()


class LiveWeights:
    """Takes weights that a learner offers, if they are what they should be, and goes back to older ones when asked.

    One thread of its own reads files; all else is done by the mapper's, in small pieces between two frames.

    Args:
        context: Of the mapper.
        bundle: Its pipeline and the weights that it was started with.
        folder: Where weights are kept, made when there are some.
        least_agreement: Share of the pixels of which the map is sure that new weights must name as the map does.
        publisher: Tells of the weights in use.
        offers: Where weights come from.
    """

    def __init__(
        self,
        context: NodeContext,
        bundle: Mapper,
        folder: Path,
        least_agreement: float,
        publisher: Publisher,
        offers: LosslessSubscriber,
    ) -> None:
        self._context = context
        self._bundle = bundle
        self._folder = folder
        self._least_agreement = least_agreement
        self._publisher = publisher
        self._offers = offers
        self._lock = threading.Lock()  # of what questions see and change
        start = OfferedWeights(0, digest_of(bundle.weights_path.read_bytes()), bundle.weights_path, "in use")
        self._versions = {0: start}
        self._in_use = start
        self._before: list[int] = []  # versions in use before, the latest last
        self._wanted: int | None = None
        self._task: _Task | None = None
        self._pause_until = 0.0
        self._judged = self._newest = 0
        self._accepted = self._contradicts = False
        self._reason = ""
        self._counts = {"weights_taken": 0, "weights_refused": 0, "weights_rolled_back": 0}
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="weights")
        self._checkpoint = bundle.checkpoint
        self._take_up()
        self._tell()

    @property
    def busy(self) -> bool:
        """Whether weights are being looked at, or have been asked for."""
        return self._task is not None or self._wanted is not None

    @property
    def counters(self) -> dict[str, int]:
        """For the mapper's status."""
        return {"weights_version": self._in_use.number, **self._counts}

    @property
    def degraded(self) -> tuple[str, ...]:
        """What does not work as it should, for the mapper's status."""
        refused = self._judged and not self._accepted
        return (f"weights {self._judged} were refused: {self._reason}",) if refused else ()

    def offer(self, update: WeightsUpdate) -> None:
        """Begin to look at weights; those that came before and were not done with give way."""
        version = OfferedWeights(
            update.version,
            update.digest,
            file_of_version(self._folder, update.version),
            "refused",
            update.score,
            update.parent_score,
            update.keyframes,
        )
        if update.version <= self._newest:
            if update.digest != self._versions.get(update.version, version).digest or update.version != self._newest:
                self._judged = update.version
                self._refuse(version, f"not newer than weights {self._newest}, which came before")
            return  # the latest ones, told once more
        self._judged = update.version
        self._newest = update.version
        if update.parent != self._in_use.digest:
            self._refuse(version, f"they were compared with others than those in use (weights {self._in_use.number})")
            return
        self._drop_task("newer ones came")
        reading = self._reader.submit(read_offer, update, version.path, self._checkpoint)
        self._task = _Task(version, reading)

    def carry_on(self, session: MapSession | None, *, mapped: bool) -> None:
        """Take what is offered, and go on with what is being looked at by one small piece; for the mapper's thread.

        Args:
            session: Follows the exchange.
            mapped: A frame was mapped since the last call, so that another one may wait: then pieces are few.
        """
        offer = self._offers.receive(0.0)
        if isinstance(offer, WeightsUpdate):
            self.offer(offer)
        began = time.monotonic()
        if session is None or not session.fused or (mapped and began < self._pause_until):
            return
        with self._lock:
            wanted, self._wanted = self._wanted, None
        if wanted is not None:
            self._begin_return(wanted)
        task = self._task
        if task is None or not task.reading.done():
            return
        try:
            self._advance(task, session)
        except (SemanticMapperError, OSError) as error:
            self._end_task(task, str(error))
        now = time.monotonic()
        self._pause_until = now + min((now - began) / MAX_SHARE, MAX_PAUSE_S)

    def describe(self) -> dict[str, Any]:
        """Fields of a ``WeightsAnswer``; for any thread."""
        with self._lock:
            listed = sorted(self._versions.values(), key=lambda v: v.number)[-LISTED:]
            if 0 not in {v.number for v in listed}:
                listed[0] = self._versions[0]
            wanted = self._wanted
            if wanted is None and self._task is not None and self._task.is_return:
                wanted = self._task.version.number
            return {
                "in_use": self._in_use.number,
                "before": self._before[-1] if self._before else None,
                "wanted": wanted,
                "entries": tuple(v.entry() for v in listed),
                **self._counts,
            }

    def ask_for(self, number: int) -> dict[str, Any]:
        """Ask for weights that were in use before; for any thread.

        Returns:
            As ``describe``.

        Raises:
            MapError: no such weights, or they were never in use.
        """
        with self._lock:
            version = self._versions.get(number)
            if version is None or version.state == "refused":
                usable = ", ".join(str(v.number) for v in self._versions.values() if v.state != "refused")
                raise MapError(f"weights {number} were never in use here, or are no longer kept; there are {usable}")
            if number != self._in_use.number:
                self._wanted = number
        return self.describe()

    def close(self) -> dict[str, Any]:
        """End the thread; what is being looked at is given up. Harmless when repeated.

        Returns:
            What became of all that was offered, as plain data.
        """
        self._drop_task("the mapper ends")
        self._reader.shutdown(wait=True, cancel_futures=True)
        state = self.describe()
        return {**state, "entries": [to_builtins(entry) for entry in state["entries"]]}

    def _take_up(self) -> None:
        """In a restarted mapper, go back to what its forerunner used, as if somebody had asked for it."""
        number, _, digest = self._context.note(_NOTE).partition(" ") if self._context.restarts else ("", "", "")
        path = file_of_version(self._folder, int(number or 0))
        if number in ("", "0") or not path.exists():
            return
        self._newest = int(number)
        self._versions[self._newest] = OfferedWeights(self._newest, digest, path, "earlier")
        self._wanted = self._newest

    def _begin_return(self, number: int) -> None:
        self._drop_task("older ones were asked for")
        version = self._versions[number]
        checkpoint = self._bundle.checkpoint
        if number:
            reading = self._reader.submit(read_weights, version.path, self._checkpoint)
        else:
            reading = self._reader.submit(lambda: checkpoint)
        self._task = _Task(version, reading, is_return=True)

    def _advance(self, task: _Task, session: MapSession) -> None:
        """One piece of the work.

        Raises:
            WeightsError, FrameError: these weights cannot be used, which says nothing about the labels behind them.
        """
        if task.trial is None:
            spread = session.snapshots[:: -(-len(session.snapshots) // COMPARED)]
            frames = () if task.is_return else tuple(frame for frame, _ in spread)
            checkpoint, pipeline = task.reading.result(), session.pipeline
            field = make_field(checkpoint.model, pipeline.config)
            task.trial = FieldTrial(pipeline, field, checkpoint.anchors, frames)
        if not task.trial.advance():
            return
        share = task.trial.agreement
        if share is not None and share < self._least_agreement:
            why = f"where the map is sure of itself, they agree with {share:.2f} of it; at least "
            self._end_task(task, f"{why}{self._least_agreement:g} is wanted (least_agreement)", contradicts=True)
            return
        self._exchange(task, task.trial, session)

    def _exchange(self, task: _Task, trial: FieldTrial, session: MapSession) -> None:
        version, before, checkpoint = task.version, self._in_use, task.reading.result()
        goes_back = version.number < before.number
        trial.exchange()
        session.follow_weights(checkpoint, version.path)
        with self._lock:
            self._checkpoint = checkpoint
            self._in_use, self._task = version, None
            self._versions[version.number] = version
            before.state, version.state = "rolled back" if goes_back else "earlier", "in use"
            self._before = [n for n in (*self._before, before.number) if n < version.number]
            self._counts["weights_rolled_back" if goes_back else "weights_taken"] += 1
            self._forget()
        if not task.is_return:
            self._accepted, self._reason, self._contradicts = True, "", False
        then = "a mapper that replaces it begins with the weights of the last note, else with those of its start"
        self._context.try_to_leave_note(_NOTE, f"{version.number} {version.digest}", then)
        _log.info(
            "weights_rolled_back" if goes_back else "weights_exchanged",
            version=version.number,
            before=before.number,
            agreement=trial.agreement,
            score=version.score,
        )
        self._tell()

    def _end_task(self, task: _Task, why: str, *, contradicts: bool = False) -> None:
        self._task = None
        if task.is_return:
            _log.error("weights_not_rolled_back", version=task.version.number, reason=why)
            self._reason = why
        else:
            self._refuse(task.version, why, contradicts=contradicts)

    def _drop_task(self, why: str) -> None:
        task, self._task = self._task, None
        if task is not None and not task.is_return:
            task.reading.add_done_callback(lambda _: task.version.path.unlink(missing_ok=True))
            self._refuse(task.version, why)

    def _refuse(self, version: OfferedWeights, why: str, *, contradicts: bool = False) -> None:
        self._accepted, self._reason, self._contradicts = False, why, contradicts
        with self._lock:
            version.reason = why
            self._versions.setdefault(version.number, version)
            self._counts["weights_refused"] += 1
            self._forget()
        _log.warning("weights_refused", version=version.number, reason=why)
        self._tell()

    def _forget(self) -> None:
        """Drop the files of refused weights and of the oldest ones, and word of the oldest of all."""
        usable = [v for v in self._versions.values() if v.number and v.state != "refused"]
        gone = {v.number for v in usable[:-KEPT]} - {self._in_use.number}
        for version in self._versions.values():
            if version.number and (version.state == "refused" or version.number in gone):
                version.path.unlink(missing_ok=True)
        gone |= set(sorted(self._versions)[1:-LISTED])
        for number in gone:
            self._versions.pop(number, None)
        self._before = [n for n in self._before if n in self._versions]

    def _tell(self) -> None:
        in_use = WeightsInUse(
            self._context.name,
            self._in_use.number,
            self._in_use.digest,
            self._newest,
            self._judged,
            self._accepted,
            self._reason,
            self._counts["weights_rolled_back"],
            self._contradicts,
        )
        self._publisher.publish(encode(in_use))
