"""Plays a log onto a socket: in step with the mapper, in the rhythm of its recording, or as fast as it is taken."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import msgspec

from semantic_mapper.errors import CodecError, LogError, NodeError, TransportError
from semantic_mapper.log_events import get_logger
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.transport.codec import Envelope, decode_as, encode
from semantic_mapper.transport.messages import EndOfStream, FrameRefused, Parts
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame

Mode = Literal["lockstep", "realtime", "fast"]
Ack = MapUpdate | FrameRefused

ACK_TOPICS = ("map", "refused")  # what a lockstep subscriber has to subscribe to
END_TIMEOUT_S = 60.0  # a lossless mapper behind a full queue needs the time of one frame to make room for the end
STOP_TIMEOUT_S = 5.0  # ... but who presses Ctrl-C does not want to wait for a mapper that hangs
_SLICE_S = 0.1

logger = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How to play.

    Args:
        mode: "lockstep": wait for the mapper's answer to each frame; "realtime": keep the recording's distances in
            time; "fast": as fast as the subscribers take frames (with a publisher of policy "block", nothing is lost).
        rate: Of "realtime"; 2 = twice as fast.
        max_frames: Stop after this many; None = all.
        subscribers: Wait for this many before the first frame.
        subscriber_timeout_s: How long to wait for them.
        ack_timeout_s: How long the mapper may take for one frame where it is waited for; the first ones compile.
        source: How the player calls itself in its ``EndOfStream``.
        from_stamp_ns: Frames captured before are passed over; 0 = none.
    """

    mode: Mode = "lockstep"
    rate: float = 1.0
    max_frames: int | None = None
    subscribers: int = 1
    subscriber_timeout_s: float = 60.0
    ack_timeout_s: float = 300.0
    source: str = "player"
    from_stamp_ns: int = 0


@dataclass(frozen=True, slots=True)
class PlayReport:
    """What was played.

    Args:
        published: Frames sent.
        fused: Of these, fused by the mapper (lockstep only).
        refused: Frames that the mapper could not use, and why (lockstep only).
        errors: Frames of the log that could not be read.
        stopped: Whether a person ended it before the log did.
    """

    published: int
    fused: int
    refused: tuple[FrameRefused, ...]
    errors: tuple[LogError, ...]
    stopped: bool


class Lockstep:
    """Sends one frame at a time and waits until the mapper has answered it, so that nothing is ever dropped.

    Args:
        publisher: Of the frames.
        acks: Subscribed to ``ACK_TOPICS`` of the mapper.
        timeout_s: How long the mapper may take for one frame.
    """

    def __init__(self, publisher: Publisher, acks: LosslessSubscriber, timeout_s: float) -> None:
        self._publisher = publisher
        self._acks = acks
        self._timeout_s = timeout_s

    def send(self, parts: Parts, envelope: Envelope, stop: threading.Event | None = None) -> Ack | None:
        """Publish one frame and wait for its answer; None where ``stop`` came first.

        Raises:
            NodeError: the mapper has gone, or has not answered in time.
            TransportError: it does not even take the frame.
        """
        self._publisher.publish(parts, self._timeout_s)
        deadline = time.monotonic() + self._timeout_s
        while stop is None or not stop.is_set():
            message = self._acks.receive(_SLICE_S)
            if isinstance(message, MapUpdate | FrameRefused) and _answers(message, envelope):
                return message
            if message is not None:
                continue
            where = f"frame seq={envelope.seq} of camera '{envelope.source}'"
            if self._acks.connections() == 0 or self._publisher.subscribers("frame", envelope.source) == 0:
                raise NodeError(f"the mapper has gone while it worked on {where}; its log says why")
            if time.monotonic() > deadline:
                raise NodeError(
                    f"the mapper has not answered {where} within {self._timeout_s:g} s; is it busy with something "
                    "else, or does it publish its answers at another endpoint?"
                )
        return None


def play(
    log: Log,
    publisher: Publisher,
    acks: LosslessSubscriber | None = None,
    options: PlayOptions | None = None,
    *,
    stop: threading.Event | None = None,
    on_frame: Callable[[Envelope, Ack | None], None] | None = None,
) -> PlayReport:
    """Publish a log: its ``StreamInfo``, its frames (the very bytes of the log), ``EndOfStream``.

    A frame that cannot be read or decoded is passed over and stands in the report; the rest is played.

    Args:
        log: To play.
        publisher: Policy "block" where nothing may be lost.
        acks: The mapper's answers; needed for lockstep. Subscribe to ``ACK_TOPICS`` of the mapper.
        options: See ``PlayOptions``.
        stop: Ends the playing early when set.
        on_frame: Called with each frame sent, with the mapper's answer in lockstep.

    Raises:
        NodeError: lockstep, and the mapper has gone or does not answer. ``EndOfStream`` has been sent then too.
        TransportError: no subscriber came, or one does not keep up.
    """
    options = options or PlayOptions()
    if options.mode == "lockstep" and acks is None:
        raise NodeError("lockstep needs the mapper's answers: give the player a subscriber to them")
    stop = stop or threading.Event()
    total = len(log) if options.max_frames is None else min(len(log), options.max_frames)
    publisher.wait_for_subscribers("frame", options.subscribers, options.subscriber_timeout_s)
    if acks is not None:
        acks.wait_until_heard(options.subscriber_timeout_s)
    metadata = dict(log.info.metadata)
    if options.from_stamp_ns:
        metadata["played_from_stamp_ns"] = str(options.from_stamp_ns)
    info = msgspec.structs.replace(log.info, frame_count=total, metadata=metadata)
    publisher.publish(encode(info, sender=options.source))
    run = _Run(log, publisher, options, stop, on_frame)
    reason, detail = "error", "the player failed"
    try:
        run.frames(Lockstep(publisher, acks, options.ack_timeout_s) if acks and options.mode == "lockstep" else None)
        reason, detail = ("stopped" if stop.is_set() else "end"), ""
    except NodeError as error:
        detail = str(error)
        raise
    finally:
        patience = STOP_TIMEOUT_S if stop.is_set() else END_TIMEOUT_S
        _say_end(
            publisher, EndOfStream(options.source, reason, run.published, detail, run.damages, run.unreadable), patience
        )
    return PlayReport(run.published, run.fused, tuple(run.refused), tuple(log.errors + run.errors), stop.is_set())


def _say_end(publisher: Publisher, end: EndOfStream, timeout_s: float) -> None:
    try:
        publisher.publish(encode(end), timeout_s)
    except (
        TransportError
    ) as error:  # a peer that does not listen any more needs no end; what led here must not be hidden
        logger.warning("end_of_stream_not_delivered", error=str(error))


class _Run:
    """The counters of one playing."""

    def __init__(
        self,
        log: Log,
        publisher: Publisher,
        options: PlayOptions,
        stop: threading.Event,
        on_frame: Callable[[Envelope, Ack | None], None] | None,
    ) -> None:
        self.log = log
        self.publisher = publisher
        self.options = options
        self.stop = stop
        self.on_frame = on_frame
        self.published = 0
        self.fused = 0
        self.refused: list[FrameRefused] = []
        self.errors: list[LogError] = []
        self._known = {str(error) for error in log.errors}  # stretches in which no frame can be made out

    def frames(self, lockstep: Lockstep | None) -> None:
        """Send frame after frame."""
        clock = _Clock(self.options.rate) if self.options.mode == "realtime" else None
        for envelope, parts in self.log.frame_parts():
            if envelope.stamp_ns < self.options.from_stamp_ns:
                continue
            if self.options.max_frames is not None and self.published >= self.options.max_frames:
                return
            if clock is not None:
                clock.wait_for(envelope.stamp_ns, self.stop)
            if self.stop.is_set():
                return
            if not self._can_be_decoded(parts, envelope):
                continue
            ack = None
            if lockstep is None:
                self.publisher.publish(parts, self.options.ack_timeout_s)
            else:
                ack = lockstep.send(parts, envelope, self.stop)
            self.published += 1
            self._count(ack)
            if self.on_frame is not None:
                self.on_frame(envelope, ack)

    @property
    def damages(self) -> tuple[str, ...]:
        """What could not be read so far: frames first."""
        texts = [str(error) for error in self.log.errors]
        return tuple(self._unreadable_frames() + [text for text in texts if text in self._known])

    @property
    def unreadable(self) -> int:
        """Frames that were left out."""
        return len(self._unreadable_frames())

    def _unreadable_frames(self) -> list[str]:
        found = [str(error) for error in (*self.log.errors, *self.errors)]
        return [text for text in found if text not in self._known]

    def _can_be_decoded(self, parts: Parts, envelope: Envelope) -> bool:
        """A subscriber would drop it without a word, and lockstep would wait for its answer for ever."""
        try:
            decode_as(PosedFrame, parts)
        except CodecError as error:
            self.errors.append(LogError(f"{self.log.path}: frame seq={envelope.seq}: {error}"))
            return False
        return True

    def _count(self, ack: Ack | None) -> None:
        if isinstance(ack, FrameRefused):
            self.refused.append(ack)
        elif ack is not None:
            self.fused += ack.fused


class _Clock:
    """Keeps the distances in time of the recording."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._first_ns: int | None = None
        self._started = 0.0

    def wait_for(self, stamp_ns: int, stop: threading.Event) -> None:
        if self._first_ns is None:
            self._first_ns, self._started = stamp_ns, time.monotonic()
        due = self._started + (stamp_ns - self._first_ns) / 1e9 / self._rate
        stop.wait(max(0.0, due - time.monotonic()))


def _answers(ack: Ack, envelope: Envelope) -> bool:
    return ack.camera_id == envelope.source and ack.seq == envelope.seq
