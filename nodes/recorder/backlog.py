"""What a recorder that is kept in waiting has heard: messages that the one before it may not have come to write."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import structlog

from semantic_mapper.errors import CodecError, LogError
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.streams import Streams
from semantic_mapper.replay.log.mcap_scan import read_payloads, scan_end
from semantic_mapper.replay.log.sequence import parts_on_disk
from semantic_mapper.transport.codec import decode_as, read_envelope
from semantic_mapper.transport.framing import unpack_parts
from semantic_mapper.transport.messages import EndOfStream
from semantic_mapper.transport.sockets import LosslessSubscriber
from semantic_mapper.transport.topics import read_topic

MAX_BYTES = 1 << 26
MAX_AGE_S = 60.0
POLL_S = 0.05
_OVERHEAD = 1024  # bytes that a message takes in a log beside its own, at most

Key = tuple[bytes, int, int]

_log = structlog.get_logger(__name__)


class Backlog:
    """The last messages of streams, and what the streams are.

    Args:
        streams: How many there are.
    """

    def __init__(self, streams: int = 1) -> None:
        self._streams = Streams(streams)
        self._infos: dict[bytes, list[bytes]] = {}
        self._kept: deque[tuple[float, int, list[bytes]]] = deque()  # when it came, its size
        self._bytes = 0

    @property
    def ended(self) -> bool:
        """Whether all streams have."""
        return self._streams.ended

    def add(self, parts: list[bytes]) -> None:
        """Keep one message, and let the oldest go."""
        name = read_topic(parts)[0].name
        if name == "info":
            self._infos[bytes(parts[1])] = parts
            return
        if name == "end":
            self._streams.end(decode_as(EndOfStream, parts))
        now, size = time.monotonic(), sum(map(len, parts))
        self._kept.append((now, size, parts))
        self._bytes += size
        while self._kept and (self._bytes > MAX_BYTES or now - self._kept[0][0] > MAX_AGE_S):
            self._bytes -= self._kept.popleft()[1]

    def missing_in_logs(self, out: Path) -> Iterator[list[bytes]]:
        """What the streams are, then what stands in none of the logs of the recorders before.

        Args:
            out: The first log; the others lie beside it under longer names.
        """
        if not self._infos:
            return
        written = _written_lately(out, self._bytes + _OVERHEAD * len(self._kept)) if self._kept else set[Key]()
        missing = [parts for _, _, parts in self._kept if _key(parts) not in written]
        self._kept.clear()
        _log.info("backlog", written_before=len(written), taken_up=len(missing))
        yield from self._infos.values()
        yield from missing


def listen_while_waiting(
    context: NodeContext, streams: int, frames: LosslessSubscriber, answers: LosslessSubscriber | None
) -> Backlog:
    """Hear all that the recorder at work hears, until it has to be replaced or the stream ends; else nothing.

    At the end of the stream the sockets are closed, as the camera stays until all who listen have left.
    """
    backlog = Backlog(streams)
    if context.waits:
        _log.info("waiting")
    while context.waits and not context.called() and not backlog.ended:
        parts = frames.receive_parts(POLL_S)
        if parts is not None:
            backlog.add(parts)
        while answers is not None and (parts := answers.receive_parts(0)) is not None:
            backlog.add(parts)
    if backlog.ended:
        frames.close()
        if answers is not None:
            answers.close()
    return backlog


def _key(parts: list[bytes]) -> Key:
    envelope = read_envelope(parts)
    return parts[0], envelope.stamp_ns, envelope.seq


def _written_lately(out: Path, length: int) -> set[Key]:
    """What is whole in the last ``length`` bytes of messages in the logs, the newest (by number: clocks jump) first."""
    found: set[Key] = set()
    for path in reversed(parts_on_disk(out).values()):
        if length <= 0:
            break
        with path.open("rb") as file:
            chunks = _last_chunks(file.fileno(), length)
            for offset, size in chunks:
                found |= _keys_of_chunk(file.fileno(), offset, size)
        length -= sum(size for _, size in chunks)
    return found


def _last_chunks(fd: int, length: int) -> list[tuple[int, int]]:
    """Enough of a log's chunks for so many bytes, or all; at its end an index of any length may stand."""
    reach = 2 * length
    while True:
        found = scan_end(fd, reach)
        if sum(size for _, size in found.chunks) >= length or reach >= found.size:
            return found.chunks
        reach *= 4


def _keys_of_chunk(fd: int, offset: int, size: int) -> set[Key]:
    try:
        return {_key(unpack_parts(payload)) for payload in read_payloads(fd, offset, size)}
    except (LogError, CodecError):  # cut off: it has to be written again
        return set()
