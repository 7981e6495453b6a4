"""Weights offered to a mapper while it maps: read in a thread, compared with the map, exchanged between two frames."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import structlog

from semantic_mapper.errors import SemanticMapperError
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
KEPT = 2  # versions whose files are kept: in use, and before these, as the note may still name those
LISTED = 64  # versions that are listed, in addition to those in use and those of the start
_WAITING = 2  # offers, of some 20 MB each
_NOTE = "weights"  # for the process that takes over when this one is killed

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Task:
    """Weights on their way into use; ``trial`` once they have been read."""

    version: WeightsEntry
    reading: Future[WeightsFile]
    resumed: bool  # after a restart, rather than offered
    trial: FieldTrial | None = None


def started_with(mapper: Mapper) -> Weights:
    """The weights of a mapper that takes no others."""
    entry = WeightsEntry(0, digest_of(mapper.weights_path.read_bytes()), "in use")
    return Weights(0, 0, 0, (entry,))


class LiveWeights(Closing):
    """Takes, refuses and lists weights, and publishes which are in use. A context manager.

    ``mapper`` is what the node was started with.
    """

    def __init__(self, context: NodeContext, options: MapperOptions, mapper: Mapper, publisher: Publisher) -> None:
        self._context = context
        self._mapper = mapper
        self._folder = Path(options.out) / FOLDER
        self._least_agreement = options.min_map_agreement
        self._publisher = publisher
        self._offers = LosslessSubscriber(context.endpoint(options.learner), ("weights",), hwm=_WAITING)
        self._lock = threading.Lock()  # of what requests see: versions and counts
        self._versions = {0: WeightsEntry(0, digest_of(mapper.weights_path.read_bytes()), "in use")}
        self._in_use = 0
        self._counts = {"taken": 0, "refused": 0}
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
        self._task = _Task(entry, reading, resumed=False)

    def describe(self) -> Weights:
        """Which weights there are; for any thread."""
        with self._lock:
            return Weights(self._in_use, **self._counts, versions=tuple(self._versions.values()))

    def end(self) -> Weights:
        """End the thread; unfinished weights are refused. Returns what became of all. Harmless when repeated."""
        self._end_task("the mapper ends")
        self._reader.shutdown(wait=True, cancel_futures=True)
        return self.describe()

    def _restore(self) -> None:
        """After a restart, go back to the weights that were in use."""
        number, _, digest = self._context.note(_NOTE).partition(" ") if self._context.restarts else ("", "", "")
        if number not in ("", "0") and file_of_version(self._folder, int(number)).exists():
            self._newest = int(number)
            entry = self._versions[self._newest] = WeightsEntry(self._newest, digest, "earlier")
            reading = self._reader.submit(read_kept, self._folder, self._newest, digest, self._mapper.weights)
            self._task = _Task(entry, reading, resumed=True)

    def _advance(self, task: _Task, found: WeightsFile, session: MapSession) -> None:
        """One piece of the work. Errors: these weights cannot be used, which says nothing about their labels."""
        if task.trial is None:
            spread = session.snapshots[:: -(-len(session.snapshots) // COMPARED)]
            frames = () if task.resumed else tuple(snapshot.open()[0] for snapshot in spread)
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
        session.follow_weights(found, file_of_version(self._folder, number))
        with self._lock:
            self._task = None
            self._in_use = number
            self._versions[before] = replace(self._versions[before], state="earlier")
            self._versions[number] = replace(task.version, state="in use")
            self._counts["taken"] += 1
            self._forget()
        if not task.resumed:
            self._answer = {"judged": number, "accepted": True}
        then = "a mapper that replaces it begins with the weights of the last note, else with those of its start"
        self._context.try_to_leave_note(_NOTE, f"{number} {task.version.digest}", then)
        _log.info("weights_exchanged", version=number, before=before, agreement=agreement, score=task.version.score)
        self._report()

    def _end_task(self, reason: str, *, contradicts: bool = False) -> None:
        task, self._task = self._task, None
        if task is not None and task.resumed:
            _log.error("weights_not_restored", version=task.version.version, reason=reason)
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
        """Delete the files of earlier weights, and drop the oldest entries."""
        numbers = sorted(self._versions)
        for number in [n for n in numbers if self._versions[n].state != "refused"][:-KEPT]:
            file_of_version(self._folder, number).unlink(missing_ok=True)
        listed = {0, self._in_use, *numbers[-LISTED:]}
        self._versions = {n: self._versions[n] for n in numbers if n in listed}

    def _report(self) -> None:
        state = (self._in_use, self._versions[self._in_use].digest, self._newest)
        self._publisher.publish(encode(WeightsInUse(self._context.name, *state, **self._answer)))
