"""Plays a log onto a socket: in step with the mapper, in the rhythm of its recording, or as fast as it is taken."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import msgspec

from semantic_mapper.errors import CodecError, LogError, NodeError, TransportError
from semantic_mapper.log_events import get_logger
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.transport.codec import Envelope, decode_as, encode, retaken
from semantic_mapper.transport.messages import EndOfStream, FrameRefused
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame

Mode = Literal["lockstep", "realtime", "fast"]

ACK_TOPICS = ("map", "refused")  # what a lockstep subscriber has to subscribe to
END_TIMEOUT_S = 60.0  # a lossless mapper behind a full queue needs the time of one frame to make room for the end
STOP_TIMEOUT_S = 5.0  # ... but who presses Ctrl-C does not want to wait for a mapper that hangs
ALONE_NS = 1_000_000_000  # between two showings of a log with one frame
_SLICE_S = 0.1

logger = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How to play."""

    # "lockstep": wait for the mapper's answer to each frame; "realtime": keep the recording's distances in time;
    # "fast": as fast as the subscribers take frames (with a publisher of policy "block", nothing is lost)
    mode: Mode = "lockstep"
    rate: float = 1.0  # of "realtime"; 2 = twice as fast
    loop: bool = False  # begin again after the last frame: stamps and numbers go on, labels come the first time only
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
    TransportError: no subscriber came, or one does not keep up. The policy of ``publisher`` is "block" where nothing
    may be lost. Lockstep needs ``acks``, which subscribe to ``ACK_TOPICS`` of the mapper. ``stop`` ends the playing
    early. ``on_frame`` is called with each frame sent, in lockstep once the mapper has answered it.
    """
    options, stop = options or PlayOptions(), stop or threading.Event()
    if options.mode == "lockstep" and acks is None:
        raise NodeError("lockstep needs the mapper's answers: give the player a subscriber to them")
    total = frames_to_play(log, options)
    publisher.wait_for_subscribers("frame", options.subscribers, options.subscriber_timeout_s)
    if acks is not None:
        acks.wait_until_heard(options.subscriber_timeout_s)
    metadata = dict(log.info.metadata)
    if options.from_stamp_ns:
        metadata["played_from_stamp_ns"] = str(options.from_stamp_ns)
    info = msgspec.structs.replace(log.info, frame_count=total, metadata=metadata)
    publisher.publish(encode(info, sender=options.source))
    known = len(log.errors)  # stretches in which no frame can be made out
    undecodable: list[LogError] = []
    published = 0
    reason, detail = "error", "the player failed"
    try:
        for envelope, parts in _due_frames(log, options, stop):
            try:  # a subscriber would drop what it cannot decode, and lockstep would wait for its answer for ever
                decode_as(PosedFrame, parts)
            except CodecError as error:
                if len(undecodable) < len(log):  # in a loop, each one comes again
                    undecodable.append(LogError(f"{log.path}: frame seq={envelope.seq}: {error}"))
                continue
            publisher.publish(parts, options.ack_timeout_s)
            if options.mode == "lockstep" and acks is not None:
                _wait_for_answer(envelope, publisher, acks, options.ack_timeout_s, stop)
            published += 1
            on_frame(envelope)
            if published == total:
                break
        reason, detail = ("stopped" if stop.is_set() else "end"), ""
    except NodeError as error:
        detail = str(error)
        raise
    finally:
        unreadable = [*log.errors[known:], *undecodable]
        damages = tuple(str(error) for error in (*unreadable, *log.errors[:known]))
        end = EndOfStream(options.source, reason, published, detail, damages, len(unreadable))
        try:
            publisher.publish(encode(end), STOP_TIMEOUT_S if stop.is_set() else END_TIMEOUT_S)
        except TransportError as error:  # who does not listen any more needs no end; what led here must not be hidden
            logger.warning("end_of_stream_not_delivered", error=str(error))
    return PlayReport(published, tuple(log.errors + undecodable), stop.is_set())


def frames_to_play(log: Log, options: PlayOptions) -> int | None:
    """How many frames are played unless somebody ends it early; None = without end."""
    if options.loop:
        return options.max_frames
    return len(log) if options.max_frames is None else min(len(log), options.max_frames)


def _looped(log: Log, from_stamp_ns: int) -> Iterator[tuple[Envelope, list[bytes]]]:
    """The frames of a log again and again, without the labels from the second time on: each is there to be scored, or
    learned from, once. Loops that end before ``from_stamp_ns`` may be left out."""
    stamps, next_seq = list[int](), 0
    for envelope, parts in log.frame_parts():
        stamps.append(envelope.stamp_ns)
        next_seq = max(next_seq, envelope.seq + 1)
        yield envelope, parts
    if not stamps:
        return
    length_ns = max(stamps) - min(stamps)
    period_ns = length_ns + (length_ns // max(len(stamps) - 1, 1) or ALONE_NS)
    for number in itertools.count(max(1, (from_stamp_ns - max(stamps)) // period_ns)):
        for envelope, parts in log.frame_parts():
            stamp_ns, seq = envelope.stamp_ns + number * period_ns, envelope.seq + number * next_seq
            yield replace(envelope, stamp_ns=stamp_ns, seq=seq, has_label=False), retaken(parts, stamp_ns, seq)


def _due_frames(log: Log, options: PlayOptions, stop: threading.Event) -> Iterator[tuple[Envelope, list[bytes]]]:
    """Frames when they are to be sent, until ``stop``."""
    began: tuple[float, int] | None = None  # clock and stamp at the first frame
    start_ns = options.from_stamp_ns
    for envelope, parts in _looped(log, start_ns) if options.loop else log.frame_parts(start_ns):
        if envelope.stamp_ns < start_ns:
            continue
        if options.mode == "realtime":  # keep the distances in time of the recording
            began = began or (time.monotonic(), envelope.stamp_ns)
            due = began[0] + (envelope.stamp_ns - began[1]) / 1e9 / options.rate
            stop.wait(max(0.0, due - time.monotonic()))
        if stop.is_set():
            return
        yield envelope, parts


def _wait_for_answer(
    envelope: Envelope, publisher: Publisher, acks: LosslessSubscriber, timeout_s: float, stop: threading.Event
) -> None:
    """Raises NodeError: the mapper has gone, or does not answer."""
    deadline = time.monotonic() + timeout_s
    where = f"frame seq={envelope.seq} of camera '{envelope.source}'"
    while not stop.is_set():
        answer = acks.receive(_SLICE_S)
        if answer is not None:
            sent = envelope.source, envelope.seq
            if isinstance(answer, MapUpdate | FrameRefused) and (answer.camera_id, answer.seq) == sent:
                return
        elif acks.connections() == 0 or publisher.subscribers("frame", envelope.source) == 0:
            raise NodeError(f"the mapper has gone while it worked on {where}; its log says why")
        elif time.monotonic() > deadline:
            raise NodeError(
                f"the mapper has not answered {where} within {timeout_s:g} s; is it busy with something else, or does "
                "it publish its answers at another endpoint?"
            )
