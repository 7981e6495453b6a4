"""Plays a log onto a socket: in step with the mapper, in the rhythm of its recording, or as fast as it is taken."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import msgspec

from semantic_mapper.errors import CodecError, LogError, NodeError, TransportError
from semantic_mapper.log_events import get_logger
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.transport.codec import Envelope, decode_as, encode
from semantic_mapper.transport.messages import EndOfStream, FrameRefused
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame

Mode = Literal["lockstep", "realtime", "fast"]

ACK_TOPICS = ("map", "refused")  # what a lockstep subscriber has to subscribe to
END_TIMEOUT_S = 60.0  # a lossless mapper behind a full queue needs the time of one frame to make room for the end
STOP_TIMEOUT_S = 5.0  # ... but who presses Ctrl-C does not want to wait for a mapper that hangs
_SLICE_S = 0.1

logger = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How to play."""

    # "lockstep": wait for the mapper's answer to each frame; "realtime": keep the recording's distances in time;
    # "fast": as fast as the subscribers take frames (with a publisher of policy "block", nothing is lost)
    mode: Mode = "lockstep"
    rate: float = 1.0  # of "realtime"; 2 = twice as fast
    max_frames: int | None = None  # stop after this many; None = all
    subscribers: int = 1  # wait for this many before the first frame
    subscriber_timeout_s: float = 60.0  # how long to wait for them
    # how long the mapper may take for one frame where it is waited for; the first ones compile
    ack_timeout_s: float = 300.0
    source: str = "player"  # how the player calls itself in its ``EndOfStream``
    from_stamp_ns: int = 0  # frames captured before are passed over; 0 = none


@dataclass(frozen=True, slots=True)
class PlayReport:
    """What was played."""

    published: int  # frames sent
    errors: tuple[LogError, ...]  # frames of the log that could not be read
    stopped: bool  # whether a person ended it before the log did


def play(
    log: Log,
    publisher: Publisher,
    acks: LosslessSubscriber | None = None,
    options: PlayOptions | None = None,
    *,
    stop: threading.Event | None = None,
    on_frame: Callable[[Envelope], None] = lambda envelope: None,
) -> PlayReport:
    """Publish a log: its ``StreamInfo``, its frames (the very bytes of the log), ``EndOfStream``.

    A frame that cannot be read or decoded is passed over and stands in the report; the rest is played. Raises
    NodeError: lockstep, and the mapper has gone or does not answer. ``EndOfStream`` has been sent then too.
    TransportError: no subscriber came, or one does not keep up.

    Args:
        log: To play.
        publisher: Policy "block" where nothing may be lost.
        acks: The mapper's answers; needed for lockstep. Subscribe to ``ACK_TOPICS`` of the mapper.
        options: See ``PlayOptions``.
        stop: Ends the playing early when set.
        on_frame: Called with each frame sent, in lockstep once the mapper has answered it.
    """
    options, stop = options or PlayOptions(), stop or threading.Event()
    if options.mode == "lockstep" and acks is None:
        raise NodeError("lockstep needs the mapper's answers: give the player a subscriber to them")
    total = len(log) if options.max_frames is None else min(len(log), options.max_frames)
    publisher.wait_for_subscribers("frame", options.subscribers, options.subscriber_timeout_s)
    if acks is not None:
        acks.wait_until_heard(options.subscriber_timeout_s)
    metadata = dict(log.info.metadata)
    if options.from_stamp_ns:
        metadata["played_from_stamp_ns"] = str(options.from_stamp_ns)
    info = msgspec.structs.replace(log.info, frame_count=total, metadata=metadata)
    publisher.publish(encode(info, sender=options.source))
    run = _Run(log, publisher, acks, options, stop)
    reason, detail = "error", "the player failed"
    try:
        for envelope in run.frames(total):
            on_frame(envelope)
        reason, detail = ("stopped" if stop.is_set() else "end"), ""
    except NodeError as error:
        detail = str(error)
        raise
    finally:
        end = EndOfStream(options.source, reason, run.published, detail, run.damages, len(run.unreadable))
        try:
            publisher.publish(encode(end), STOP_TIMEOUT_S if stop.is_set() else END_TIMEOUT_S)
        except TransportError as error:  # who does not listen any more needs no end; what led here must not be hidden
            logger.warning("end_of_stream_not_delivered", error=str(error))
    return PlayReport(run.published, tuple(log.errors + run.errors), stop.is_set())


class _Run:
    """One playing: what was sent, and what could not be."""

    def __init__(
        self,
        log: Log,
        publisher: Publisher,
        acks: LosslessSubscriber | None,
        options: PlayOptions,
        stop: threading.Event,
    ) -> None:
        self._log, self._publisher, self._acks, self._options, self._stop = log, publisher, acks, options, stop
        self._known = {str(error) for error in log.errors}  # stretches in which no frame can be made out
        self._began: tuple[float, int] | None = None  # clock and stamp at the first frame
        self.published = 0
        self.errors: list[LogError] = []

    def frames(self, total: int) -> Iterator[Envelope]:
        """Send frame after frame."""
        for envelope, parts in self._log.frame_parts():
            if envelope.stamp_ns < self._options.from_stamp_ns:
                continue
            if self.published >= total:
                return
            if self._options.mode == "realtime":
                self._wait_for(envelope.stamp_ns)
            if self._stop.is_set():
                return
            try:  # a subscriber would drop what it cannot decode, and lockstep would wait for its answer for ever
                decode_as(PosedFrame, parts)
            except CodecError as error:
                self.errors.append(LogError(f"{self._log.path}: frame seq={envelope.seq}: {error}"))
                continue
            self._publisher.publish(parts, self._options.ack_timeout_s)
            if self._options.mode == "lockstep":
                self._wait_for_answer(envelope)
            self.published += 1
            yield envelope

    @property
    def unreadable(self) -> list[str]:
        """Frames that were left out so far."""
        found = [str(error) for error in (*self._log.errors, *self.errors)]
        return [text for text in found if text not in self._known]

    @property
    def damages(self) -> tuple[str, ...]:
        """What could not be read so far: frames first."""
        return (*self.unreadable, *(text for error in self._log.errors if (text := str(error)) in self._known))

    def _wait_for(self, stamp_ns: int) -> None:
        """Keep the distances in time of the recording."""
        began, first_ns = self._began = self._began or (time.monotonic(), stamp_ns)
        due = began + (stamp_ns - first_ns) / 1e9 / self._options.rate
        self._stop.wait(max(0.0, due - time.monotonic()))

    def _wait_for_answer(self, envelope: Envelope) -> None:
        assert self._acks is not None
        deadline = time.monotonic() + self._options.ack_timeout_s
        where = f"frame seq={envelope.seq} of camera '{envelope.source}'"
        while not self._stop.is_set():
            answer = self._acks.receive(_SLICE_S)
            if answer is not None:
                sent = envelope.source, envelope.seq
                if isinstance(answer, MapUpdate | FrameRefused) and (answer.camera_id, answer.seq) == sent:
                    return
                continue
            if self._acks.connections() == 0 or self._publisher.subscribers("frame", envelope.source) == 0:
                raise NodeError(f"the mapper has gone while it worked on {where}; its log says why")
            if time.monotonic() > deadline:
                raise NodeError(
                    f"the mapper has not answered {where} within {self._options.ack_timeout_s:g} s; is it busy with "
                    "something else, or does it publish its answers at another endpoint?"
                )
