"""Weights offered to a mapper while it maps: read in a thread, compared with the map, exchanged between two frames."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import structlog

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.fields.weights import WeightsFile
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.pipeline import FieldTrial
from semantic_mapper.nodes.mapper.offered_weights import FOLDER, file_of_version, keep_offer, read_kept
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import MapperOptions
from semantic_mapper.nodes.publishing import PartStatus
from semantic_mapper.queries.questions import Weights, WeightsEntry
from semantic_mapper.replay.session import MapSession
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import Closing
from semantic_mapper.transport.messages import WeightsInUse, WeightsUpdate, digest_of
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

COMPARED = 4  # frames of the session, well spread, in which new weights are compared with the map
MAX_PAUSE_S = 5.0  # the first look may compile
MAX_FRACTION = 0.1  # of the mapper's time that looking at new weights may take; the pause after a long look is longer
KEPT = 8  # versions whose files are kept, in addition to those that the mapper was started with
LISTED = 64  # versions that are listed
_WAITING = 2  # offers, of some 20 MB each
_NOTE = "weights"  # for the process that takes over when this one is killed

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Task:
    """Weights on their way into use; ``trial`` once they have been read."""

    version: WeightsEntry
    reading: Future[WeightsFile]
    requested: bool  # by a person, rather than offered
    trial: FieldTrial | None = None


def started_with(mapper: Mapper) -> Weights:
    """The weights of a mapper that takes no others."""
    entry = WeightsEntry(0, digest_of(mapper.weights_path.read_bytes()), "in use")
    return Weights(0, None, None, 0, 0, 0, (entry,))


class LiveWeights(Closing):
    """Takes, refuses and lists weights, goes back to earlier ones, and publishes which are in use. A context manager.

    ``mapper`` is what the node was started with.
    """

    def __init__(self, context: NodeContext, options: MapperOptions, mapper: Mapper, publisher: Publisher) -> None:
        self._context = context
        self._mapper = mapper
        self._folder = Path(options.out) / FOLDER
        self._least_agreement = options.min_map_agreement
        self._publisher = publisher
        self._offers = LosslessSubscriber(context.endpoint(options.learner), ("weights",), hwm=_WAITING)
        self._lock = threading.Lock()  # of what requests see and change: versions, counts, the one requested
        self._versions = {0: WeightsEntry(0, digest_of(mapper.weights_path.read_bytes()), "in use")}
        self._in_use = 0
        self._requested: int | None = None
        self._counts = {"taken": 0, "refused": 0, "rolled_back": 0}
        self._newest = 0
        self._answer: dict[str, Any] = {}  # to the last offer; fields of ``WeightsInUse``
        self._task: _Task | None = None
        self._pause_until = 0.0
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="weights")
        self._restore()
        self._report()

    def status(self) -> PartStatus:
        """For the mapper's status."""
        counters = {"weights_version": self._in_use} | {f"weights_{name}": n for name, n in self._counts.items()}
        reason = self._answer.get("reason")
        return PartStatus(counters, (f"weights {self._answer['judged']} were refused: {reason}" if reason else "",))

    def close(self) -> None:
        """End, and receive no more offers."""
        self.end()
        self._offers.close()

    def advance(self, session: MapSession | None, *, mapped: bool) -> None:
        """Receive an offer, and do one small piece of the work; for the mapper's thread. ``session`` follows the
        exchange. Where a frame was ``mapped`` since the last call, another one may wait: then pieces are few."""
        if isinstance(offer := self._offers.receive(0.0), WeightsUpdate):
            self.offer(offer)
        began = time.monotonic()
        if session is None or not session.fused or (mapped and began < self._pause_until):
            return
        with self._lock:
            requested, self._requested = self._requested, None
        if requested is not None:
            self._end_task("older ones were requested")
            entry, start = self._versions[requested], self._mapper.weights
            read = partial(read_kept, self._folder, requested, entry.digest, start) if requested else lambda: start
            self._task = _Task(entry, self._reader.submit(read), requested=True)
        task = self._task
        if task is None or not task.reading.done():
            return
        try:
            self._advance(task, task.reading.result(), session)
        except (SemanticMapperError, OSError) as error:
            self._end_task(str(error))
        now = time.monotonic()
        self._pause_until = now + min((now - began) / MAX_FRACTION, MAX_PAUSE_S)

    def offer(self, update: WeightsUpdate) -> None:
        """Begin to look at weights; unfinished earlier ones are refused."""
        scores = (update.score, update.parent_score, update.keyframes)
        entry = WeightsEntry(update.version, update.digest, "refused", *scores)  # until they are taken
        if update.version <= self._newest:
            known = self._versions.get(update.version, entry)
            if update.version != self._newest or known.digest != update.digest:  # else it is only repeated
                self._refuse(entry, f"not newer than weights {self._newest}, which came before")
            return
        self._newest = update.version
        if update.parent != self._versions[self._in_use].digest:
            self._refuse(entry, f"they were compared with others than those in use (weights {self._in_use})")
            return
        self._end_task("newer ones came")
        reading = self._reader.submit(keep_offer, update, self._folder, self._mapper.weights)
        self._task = _Task(entry, reading, requested=False)

    def describe(self) -> Weights:
        """Which weights there are; for any thread."""
        with self._lock:
            requested = self._requested
            if requested is None and self._task is not None and self._task.requested:
                requested = self._task.version.version
            earlier = [n for n, v in self._versions.items() if v.state == "earlier" and n < self._in_use]
            versions = tuple(self._versions.values())
            before = max(earlier, default=None)
            return Weights(self._in_use, before, requested, **self._counts, versions=versions)

    def return_to(self, number: int) -> Weights:
        """Request weights that were in use before; for any thread. ``MapError`` for an unknown number."""
        with self._lock:
            usable = [n for n, v in self._versions.items() if v.state != "refused"]
            if number not in usable:
                there_are = ", ".join(map(str, usable))
                raise MapError(f"weights {number} were never in use here, or are no longer kept; there are {there_are}")
            if number != self._in_use:
                self._requested = number
        return self.describe()

    def end(self) -> Weights:
        """End the thread; unfinished weights are refused. Returns what became of all. Harmless when repeated."""
        self._end_task("the mapper ends")
        self._reader.shutdown(wait=True, cancel_futures=True)
        return self.describe()

    def _restore(self) -> None:
        """After a restart, go back to the weights that were in use, as if a person had requested them."""
        number, _, digest = self._context.note(_NOTE).partition(" ") if self._context.restarts else ("", "", "")
        if number not in ("", "0") and file_of_version(self._folder, int(number)).exists():
            self._requested = self._newest = int(number)
            self._versions[self._newest] = WeightsEntry(self._newest, digest, "earlier")

    def _advance(self, task: _Task, found: WeightsFile, session: MapSession) -> None:
        """One piece of the work. Errors: these weights cannot be used, which says nothing about their labels."""
        if task.trial is None:
            spread = session.snapshots[:: -(-len(session.snapshots) // COMPARED)]
            frames = () if task.requested else tuple(snapshot.open()[0] for snapshot in spread)
            field = make_field(found, session.pipeline.config, session.pipeline.field)
            task.trial = FieldTrial(session.pipeline, field, found.anchors, frames)
        if not task.trial.advance():
            return
        agreement = task.trial.agreement
        if agreement is not None and agreement < self._least_agreement:
            least = f"at least {self._least_agreement:g} is required (min_map_agreement)"
            self._end_task(
                f"where the map is sure of itself, they agree with {agreement:.2f}; {least}", contradicts=True
            )
            return
        task.trial.exchange()
        number, before = task.version.version, self._in_use
        back = number < before
        file = file_of_version(self._folder, number) if number else self._mapper.weights_path
        session.follow_weights(found, file)
        with self._lock:
            self._task = None
            self._in_use = number
            self._versions[before] = replace(self._versions[before], state="rolled back" if back else "earlier")
            self._versions[number] = replace(task.version, state="in use")
            self._counts["rolled_back" if back else "taken"] += 1
            self._forget()
        if not task.requested:
            self._answer = {"judged": number, "accepted": True}
        then = "a mapper that replaces it begins with the weights of the last note, else with those of its start"
        self._context.try_to_leave_note(_NOTE, f"{number} {task.version.digest}", then)
        event = "weights_rolled_back" if back else "weights_exchanged"
        _log.info(event, version=number, before=before, agreement=agreement, score=task.version.score)
        self._report()

    def _end_task(self, reason: str, *, contradicts: bool = False) -> None:
        task, self._task = self._task, None
        if task is not None and task.requested:
            _log.error("weights_not_rolled_back", version=task.version.version, reason=reason)
        elif task is not None:
            path = file_of_version(self._folder, task.version.version)
            task.reading.add_done_callback(lambda _: path.unlink(missing_ok=True))
            self._refuse(task.version, reason, contradicts=contradicts)

    def _refuse(self, entry: WeightsEntry, reason: str, *, contradicts: bool = False) -> None:
        self._answer = {"judged": entry.version, "reason": reason, "contradicts": contradicts}
        with self._lock:
            self._versions.setdefault(entry.version, replace(entry, reason=reason[:512]))
            self._counts["refused"] += 1
            self._forget()
        _log.warning("weights_refused", version=entry.version, reason=reason)
        self._report()

    def _forget(self) -> None:
        """Delete the files of refused and of the oldest weights, and drop the oldest entries."""
        usable = [n for n in sorted(self._versions) if self._versions[n].state != "refused"]
        kept = {0, self._in_use, *usable[-KEPT:]}
        for number in set(self._versions) - kept:
            file_of_version(self._folder, number).unlink(missing_ok=True)
        refused = [n for n in sorted(self._versions) if self._versions[n].state == "refused"]
        listed = kept.union(refused[-LISTED + len(kept) :])
        self._versions = {n: v for n, v in sorted(self._versions.items()) if n in listed}

    def _report(self) -> None:
        state = (self._in_use, self._versions[self._in_use].digest, self._newest)
        rolled_back = self._counts["rolled_back"]
        in_use = WeightsInUse(self._context.name, *state, rolled_back=rolled_back, **self._answer)
        self._publisher.publish(encode(in_use))
