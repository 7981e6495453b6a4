"""The camera node: publishes posed frames, of a log that it plays or of a camera."""

import dataclasses
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import structlog

from semantic_mapper.errors import LogError
from semantic_mapper.nodes.camera.listeners import START_S, drain, wait_for_listeners
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import CameraOptions
from semantic_mapper.replay.log.player import ACK_TOPICS, PlayOptions, frames_to_play, play
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.codec import Envelope
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

_BEGAN = "began"  # note: when the first frame was published, and its stamp

_log = structlog.get_logger(__name__)


def run_camera(context: NodeContext, options: CameraOptions) -> None:
    """Publish frames to the end of the source, or until stopped.

    Raises LogError: the log cannot be read. NodeError: lockstep, and the mapper has gone. TransportError: nobody
    subscribes. CameraError, ConfigError: see ``run_live_camera``.
    """
    if options.camera is not None:
        from semantic_mapper.nodes.camera.live import run_live_camera  # loads GTSAM, which a log has no need of

        run_live_camera(context, options, options.camera)
    elif options.log is not None:
        _play(context, options, Path(options.log))


def _play(context: NodeContext, options: CameraOptions, path: Path) -> None:
    def on_error(error: LogError) -> None:
        _log.error("log_damaged", error=str(error))

    play_options = PlayOptions(
        mode=options.mode,
        rate=options.rate,
        loop=options.loop,
        max_frames=options.max_frames or None,
        subscribers=context.subscribers,
        subscriber_timeout_s=START_S,
        ack_timeout_s=options.ack_timeout_s,
        source=context.name,
    )
    stopped = threading.Event()
    policy = "drop" if options.mode == "realtime" else "block"
    with (
        open_log(path, on_error=on_error) as log,
        Publisher(context.endpoint(context.name), policy=policy) as publisher,
    ):
        context.heartbeat.ready()
        _log.info("playing", log=str(path), frames=len(log), mode=options.mode)
        threading.Thread(target=_pass_on_stop, args=(context, stopped), daemon=True).start()
        with ExitStack() as stack:
            acks = None
            if options.mode == "lockstep":
                acks = stack.enter_context(LosslessSubscriber(context.endpoint(options.mapper), ACK_TOPICS))
            if not wait_for_listeners(context, publisher, acks):
                _log.info("played", published=0, stopped=True)
                return
            total = frames_to_play(log, play_options)
            bar = stack.enter_context(frame_progress("played", total)) if total else None
            playback = Playback(context, options.rate)

            def on_frame(envelope: Envelope) -> None:
                if bar is not None:
                    bar.advance()
                playback.note_frame(envelope.stamp_ns)

            play_options = dataclasses.replace(play_options, from_stamp_ns=playback.due_stamp_ns())
            report = play(log, publisher, acks, play_options, stop=stopped, on_frame=on_frame)
        for error in report.errors[len(log.errors) :]:
            _log.error("frame_left_out", error=str(error))
        _log.info("played", published=report.published, damaged=len(report.errors), stopped=report.stopped)
        context.heartbeat.ending()
        drain(context, publisher)


class Playback:
    """Where a restarted player goes on: where the recording is by now, as a camera would; ``rate`` times as fast."""

    def __init__(self, context: NodeContext, rate: float) -> None:
        self._context = context
        self._rate = rate
        self._began = context.note(_BEGAN) if context.restarts else ""

    def due_stamp_ns(self) -> int:
        """Stamp of the recording that is due now; 0 where it has not begun."""
        if not self._began:
            return 0
        began_ns, stamp_ns = map(int, self._began.split())
        return stamp_ns + round((time.monotonic_ns() - began_ns) * self._rate)

    def note_frame(self, stamp_ns: int) -> None:
        """A frame of this stamp is published: the launcher counts it, and the first of all is noted."""
        self._context.heartbeat.frame()
        if not self._began:
            self._began = f"{time.monotonic_ns()} {stamp_ns}"
            self._context.try_to_leave_note(_BEGAN, self._began, "a restarted camera plays from the first frame")


def _pass_on_stop(context: NodeContext, stopped: threading.Event) -> None:
    while not stopped.wait(0.05):
        if context.stop:
            stopped.set()
