"""The recorder node: writes what other nodes publish to a log, and loses nothing."""

from __future__ import annotations

import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from nodes.node import NodeContext, run_node
from nodes.options import RecorderOptions
from semantic_mapper.errors import LogError, TransportError

if TYPE_CHECKING:
    from replay.log import LogWriter
    from semantic_mapper.transport.sockets import LosslessSubscriber

POLL_S = 0.05
WAIT_SLICE_S = 0.2
QUIET_S = 0.5  # after the end of the stream, answers from other nodes may still be on their way
MAX_EARLY = 1000  # messages kept while no stream has begun

_log = structlog.get_logger(__name__)


def run_recorder(context: NodeContext, options: RecorderOptions) -> None:
    """Record until the stream ends or somebody asks to stop.

    Raises:
        LogError: the log cannot be written.
        TransportError: a source cannot be subscribed to.
    """
    from semantic_mapper.transport.sockets import LosslessSubscriber

    topics = tuple(dict.fromkeys(("info", *options.topics, "end")))
    stream, *others = (context.endpoint(name) for name in options.sources)
    recording = _Recording(Path(options.out), options)
    with ExitStack() as stack:
        answers = None
        if others:
            answers = stack.enter_context(LosslessSubscriber(others, topics))
            _wait_until_heard(context, options, answers)
        # The camera begins once it has all its subscribers, so this one comes last: by now nothing can be missed.
        frames = stack.enter_context(LosslessSubscriber(stream, topics))
        stack.callback(recording.close)
        ended_at = 0.0
        while not (ended_at and time.monotonic() - ended_at > QUIET_S) and not context.stop:
            parts = frames.receive_parts(POLL_S)
            if parts is not None and recording.take(parts):
                ended_at = ended_at or time.monotonic()
            while answers is not None and (parts := answers.receive_parts(0)) is not None:
                recording.take(parts)


def _wait_until_heard(context: NodeContext, options: RecorderOptions, answers: LosslessSubscriber) -> None:
    """Wait, in slices, until the other sources know of us; return early on a stop request.

    Raises:
        TransportError: they do not answer within ``options.source_timeout_s``.
    """
    deadline = time.monotonic() + options.source_timeout_s
    while not context.stop:
        try:
            return answers.wait_until_heard(WAIT_SLICE_S)
        except TransportError:
            if time.monotonic() > deadline:
                raise
    return None


class _Recording:
    """The log, opened once it is known what the stream is."""

    def __init__(self, path: Path, options: RecorderOptions) -> None:
        self._path = path
        self._options = options
        if path.exists() and not options.overwrite:  # before the stream begins, so that nothing else is overwritten
            raise LogError(f"{path}: exists already; give another folder or set overwrite = true")
        self._log: LogWriter | None = None
        self._early: deque[list[bytes]] = deque(maxlen=MAX_EARLY)

    def take(self, parts: list[bytes]) -> bool:
        """Keep one message; True where it was the end of the stream."""
        from replay.log import LogWriter
        from semantic_mapper.transport.codec import decode_info
        from semantic_mapper.transport.topics import parse_topic

        topic, _ = parse_topic(parts[0])
        if topic.name == "info":
            if self._log is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._log = LogWriter(self._path, decode_info(parts), overwrite=self._options.overwrite)
                _log.info("recording", log=str(self._path))
                for early in self._early:
                    self._log.write_parts(early)
                self._early.clear()
        elif topic.name != "end":
            if self._log is None:
                self._early.append(parts)
            else:
                self._log.write_parts(parts)
        return topic.name == "end"

    def close(self) -> None:
        """Finish the log."""
        if self._log is None:
            _log.warning("nothing_recorded", reason="no stream has begun")
            return
        self._log.close()
        _log.info("recorded", log=str(self._path), frames=self._log.frames, messages=self._log.messages)


if __name__ == "__main__":
    run_node(RecorderOptions, run_recorder)
