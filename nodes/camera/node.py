"""The camera node: publishes posed frames, of a log that it plays or of a camera."""

from __future__ import annotations

import dataclasses
import threading
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import structlog

from semantic_mapper.errors import LogError
from semantic_mapper.nodes.camera.listeners import drain, wait_for_listeners
from semantic_mapper.nodes.camera.resume_playback import Beginning
from semantic_mapper.nodes.cli.console import frame_progress
from semantic_mapper.nodes.node import NodeContext, run_node
from semantic_mapper.nodes.options import CameraOptions

if TYPE_CHECKING:
    from semantic_mapper.transport.codec import Envelope

PACKAGES = (
    "semantic_mapper.replay.log.player",
    "semantic_mapper.replay.log.sequence",
    "semantic_mapper.transport.sockets",
)

_log = structlog.get_logger(__name__)


def run_camera(context: NodeContext, options: CameraOptions) -> None:
    """Publish frames to the end of the source, or until stopped.

    Raises:
        LogError, NodeError, TransportError: see ``_play``.
        CameraError, ConfigError: see ``run_live_camera``.
    """
    if options.camera is not None:
        from semantic_mapper.nodes.camera.live import run_live_camera

        run_live_camera(context, options, options.camera)
    elif options.log is not None:
        _play(context, options, Path(options.log))


def _play(context: NodeContext, options: CameraOptions, path: Path) -> None:
    """Play a log to its end, or until stopped.

    Raises:
        LogError: the log cannot be read.
        NodeError: lockstep, and the mapper has gone.
        TransportError: nobody subscribes.
    """
    from semantic_mapper.replay.log.player import ACK_TOPICS, PlayOptions, play
    from semantic_mapper.replay.log.sequence import open_log
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
    with open_log(path, on_error=on_error) as log:
        context = context.await_turn()
        policy = "drop" if options.mode == "realtime" else "block"
        with Publisher(context.endpoint(context.name), policy=policy) as publisher:
            context.heart.ready()
            _log.info("playing", log=str(path), frames=len(log), mode=options.mode)
            watcher = threading.Thread(target=_pass_on_stop, args=(context, stopped), daemon=True)
            watcher.start()
            acks = None
            if options.mode == "lockstep":
                acks = LosslessSubscriber(context.endpoint(options.mapper), ACK_TOPICS)
            total = min(len(log), options.max_frames or len(log))
            try:
                if not wait_for_listeners(context, publisher, options.subscriber_timeout_s, acks):
                    _log.info("played", published=0, stopped=True)
                    return
                with frame_progress("played", total) as bar:
                    began = Beginning(context, options.rate)

                    def on_frame(envelope: Envelope, ack: object) -> None:
                        bar.advance()
                        began.note(envelope.stamp_ns)

                    play_options = dataclasses.replace(play_options, from_stamp_ns=began.due_stamp_ns())
                    report = play(log, publisher, acks, play_options, stop=stopped, on_frame=on_frame)
            finally:
                if acks is not None:
                    acks.close()
            for error in report.errors[len(log.errors) :]:
                _log.error("frame_left_out", error=str(error))
            _log.info("played", published=report.published, damaged=len(report.errors), stopped=report.stopped)
            context.heart.ending()
            drain(context, publisher)


def _pass_on_stop(context: NodeContext, stopped: threading.Event) -> None:
    while not stopped.wait(0.05):
        if context.stop:
            stopped.set()


def main() -> NoReturn:
    """Run the node of this process to its end, then exit."""
    run_node(CameraOptions, run_camera, PACKAGES)
