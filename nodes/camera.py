"""The camera node: publishes posed frames. In this version they come from a log, which is played."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import structlog

from nodes.console import frame_progress
from nodes.node import NodeContext, run_node
from nodes.options import CameraOptions
from semantic_mapper.errors import LogError, TransportError

if TYPE_CHECKING:
    from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

DRAIN_S = 600.0  # how long subscribers may take to work off what waits for them after the last frame
WAIT_SLICE_S = 0.2
STOP_DRAIN_S = 3.0  # the same after a stop request

_log = structlog.get_logger(__name__)


def run_camera(context: NodeContext, options: CameraOptions) -> None:
    """Play a log to its end, or until stopped.

    Raises:
        LogError: the log cannot be read.
        NodeError: lockstep, and the mapper has gone.
        TransportError: nobody subscribes.
    """
    from replay.log import LogReader
    from replay.player import ACK_TOPICS, PlayOptions, play
    from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

    def on_error(error: LogError) -> None:
        _log.error("log_damaged", error=str(error))

    play_options = PlayOptions(
        mode=options.mode,
        rate=options.rate,
        max_frames=options.max_frames or None,
        subscribers=context.subscribers,
        subscriber_timeout_s=options.subscriber_timeout_s,
        ack_timeout_s=options.ack_timeout_s,
        source=context.name,
    )
    stopped = threading.Event()
    with LogReader(Path(options.log), on_error=on_error) as log:
        policy = "drop" if options.mode == "realtime" else "block"
        with Publisher(context.endpoint(context.name), policy=policy) as publisher:
            _log.info("playing", log=options.log, frames=len(log), mode=options.mode)
            watcher = threading.Thread(target=_pass_on_stop, args=(context, stopped), daemon=True)
            watcher.start()
            acks = None
            if options.mode == "lockstep":
                acks = LosslessSubscriber(context.endpoint(options.mapper), ACK_TOPICS)
            total = min(len(log), options.max_frames or len(log))
            try:
                if not _wait_for_listeners(context, options, publisher, acks):
                    return
                with frame_progress("played", total) as bar:
                    report = play(
                        log, publisher, acks, play_options, stop=stopped, on_frame=lambda envelope, ack: bar.advance()
                    )
            finally:
                if acks is not None:
                    acks.close()
            for error in report.errors[len(log.errors) :]:
                _log.error("frame_left_out", error=str(error))
            _log.info("played", published=report.published, damaged=len(report.errors), stopped=report.stopped)
            _drain(context, publisher)


def _wait_for_listeners(
    context: NodeContext, options: CameraOptions, publisher: Publisher, acks: LosslessSubscriber | None
) -> bool:
    """Wait until all others are there, in slices: False where a stop request came first.

    Raises:
        TransportError: too few within the time.
    """
    deadline = time.monotonic() + options.subscriber_timeout_s
    while not context.stop:
        try:
            publisher.wait_for_subscribers("frame", context.subscribers, WAIT_SLICE_S)
            if acks is not None:
                acks.wait_until_heard(WAIT_SLICE_S)
            return True
        except TransportError:
            if time.monotonic() > deadline:
                raise
    return False


def _pass_on_stop(context: NodeContext, stopped: threading.Event) -> None:
    while not stopped.wait(0.05):
        if context.stop:
            stopped.set()


def _drain(context: NodeContext, publisher: Publisher) -> None:
    """Stay until the subscribers have left, which they do after the end of the stream: only then is all delivered."""
    began = time.monotonic()
    while publisher.subscribers("frame") and time.monotonic() - began < (STOP_DRAIN_S if context.stop else DRAIN_S):
        time.sleep(0.05)


if __name__ == "__main__":
    run_node(CameraOptions, run_camera)
