"""The camera node over a camera: posed frames go out, and its warnings with them.

Frames of a live camera are dropped rather than held back; those of a video file wait for their readers.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Self

import structlog

from semantic_mapper.config import convert_config
from semantic_mapper.drivers.base import Camera
from semantic_mapper.drivers.mounts import mount_for
from semantic_mapper.drivers.poses.config import PoseChecks, begins_world, can_be_found, gives_metres
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import make_poses, read_pose_config
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.errors import CameraError, ConfigError, TransportError
from semantic_mapper.nodes.camera.corrections import CorrectionSender, without_loops
from semantic_mapper.nodes.camera.listeners import drain, wait_for_listeners
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import CameraOptions, LiveCamera, table_of
from semantic_mapper.nodes.publishing import publish_status
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import EndOfStream, EndReason, NodeState, Parts, Status
from semantic_mapper.transport.sockets import Publisher
from semantic_mapper.types import PosedFrame

STATUS_PERIOD_S = 1.0
POLL_S = 0.05  # how soon a stop request is passed on
SEND_SLICE_S = 0.2  # between two looks at whether to stop, while a reader has no room for the next frame
FIRST_PAUSE_S = 0.2  # before a camera that could not be opened is tried again; doubles each time
MAX_PAUSE_S = 2.0

_log = structlog.get_logger(__name__)


def run_live_camera(context: NodeContext, options: CameraOptions, live: LiveCamera) -> None:
    """Publish a camera's frames until it ends (a video) or somebody asks to stop.

    Raises:
        ConfigError: of the camera or of the poses: unknown keys, wrong values; or the node is to be restarted, and
            the world of its poses would be another one then.
        CameraError: the camera can never work with its config, or was not there within ``open_s``.
        DependencyError: the kind needs something that is not installed.
        TransportError: the endpoint is taken.
    """
    policy = "block" if make_source(live).can_wait else "drop"  # mistakes in the config are found here, before any wait
    if context.restartable:
        check_world(context.name, live)
    live, note = (live, "") if options.corrections else without_loops(live)
    with (
        Publisher(context.endpoint(context.name), policy=policy) as publisher,
        _StatusReporter(context, publisher, note) as reporter,
    ):
        context.heartbeat.ready()  # a camera may be plugged in much later
        with ExitStack() as stack:
            source = _open(context, live, reporter, stack)
            if source is None:
                return
            _listeners(context, options, publisher)
            sender = _correction_sender(context, options, live, stack)
            reporter.sender = sender
            with reporter.watching_driver():
                _publish(context, options, publisher, reporter, source, sender)
        context.heartbeat.ending()
        drain(context, publisher)


def check_world(name: str, live: LiveCamera) -> None:
    """A camera without depth that tracks itself must not come back: it could not be found in the map again.

    Raises:
        ConfigError: it is to be restarted.
    """
    config, where = table_of(live.poses, "camera.poses")
    poses = read_pose_config({key: value for key, value in config.items() if key != "checks"}, where)
    if begins_world(poses) and not can_be_found(poses):
        raise ConfigError(
            f"node '{name}' is to be restarted where it fails, but poses of kind '{poses.kind}' begin in "
            "another world then, and without depth, or with a T_world_start of its own, the camera is not found in the "
            'map again: set restart = "never" (the launch ends then, and the map is written), or take poses from a '
            "topic or a board"
        )


def make_source(live: LiveCamera) -> PosedCamera:
    """The camera with its poses, not open yet.

    Raises:
        ConfigError, CameraError, DependencyError: see ``run_live_camera``.
    """
    config, where = table_of(live.config, "camera.config")
    return with_poses(open_camera(live.kind, config, live.id, where), live, config)


def with_poses(camera: Camera, live: LiveCamera, driver: dict[str, Any]) -> PosedCamera:
    """A camera whose frames get their poses from the source that a config names; its ``checks`` say what is refused.

    Raises:
        ConfigError, CameraError: see ``run_live_camera``.
    """
    config = dict(table_of(live.poses, "camera.poses")[0])
    checks = convert_config(config.pop("checks", {}), PoseChecks, "poses: checks")
    poses = read_pose_config(config)
    mount = mount_for(poses, live.T_rig_camera, live.kind, driver, f"camera '{live.id}'")
    return PosedCamera(camera, make_poses(poses), checks, T_rig_camera=mount, scale_known=gives_metres(poses))


def _open(context: NodeContext, live: LiveCamera, reporter: _StatusReporter, stack: ExitStack) -> PosedCamera | None:
    """An open source, which ``stack`` closes; None where a stop request came first.

    Raises:
        CameraError: it could not be opened within ``live.open_s``.
    """
    began, failures, last_error = time.monotonic(), 0, ""
    while not context.stop:
        source = make_source(live)
        try:
            with reporter.watching_driver():
                stack.enter_context(source)
        except CameraError as error:
            if live.open_s and time.monotonic() - began > live.open_s:
                raise
            if str(error) != last_error:
                _log.warning("camera_not_open", reason=str(error))
            last_error = reporter.waiting_for = str(error)
        else:
            reporter.watch(source)
            return source
        failures += 1
        _pause(context, min(FIRST_PAUSE_S * 2.0 ** min(failures - 1, 64), MAX_PAUSE_S))
    return None


def _pause(context: NodeContext, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not context.stop and time.monotonic() < deadline:
        time.sleep(POLL_S)


def _listeners(context: NodeContext, options: CameraOptions, publisher: Publisher) -> None:
    """Give the others time to start; a camera does not end because one of them does not come."""
    try:
        wait_for_listeners(context, publisher)
    except TransportError as error:
        _log.warning("some_do_not_listen", reason=str(error))


def _correction_sender(
    context: NodeContext, options: CameraOptions, live: LiveCamera, stack: ExitStack
) -> CorrectionSender | None:
    """Takes closed loops to the mapper, where the options name one; ``stack`` ends it."""
    named = options.corrections
    if not named:
        return None
    return stack.enter_context(CorrectionSender(named if "://" in named else context.endpoint(named), live.id))


def _publish(
    context: NodeContext,
    options: CameraOptions,
    publisher: Publisher,
    reporter: _StatusReporter,
    source: PosedCamera,
    sender: CorrectionSender | None,
) -> None:
    publisher.publish(encode(source.info, sender=context.name))
    _log.info("publishing", source=source.info.source)
    reason: EndReason = "error"
    detail = "the camera node failed"
    try:
        for frame in source:
            if context.stop:
                break
            if not _send_frame(context, options, publisher, encode_frame(frame)):
                break
            reporter.sent(frame)
            _correct(source, sender)
            if options.max_frames and reporter.published >= options.max_frames:
                break
        _correct(source, sender, final=True)
        reason, detail = ("stopped" if context.stop else "end"), ""
    except CameraError as error:
        detail = str(error)
        raise
    finally:
        if reason != "error" or not context.restartable:  # else the stream goes on with the process after this one
            _send_end(publisher, encode(EndOfStream(context.name, reason, reporter.published, detail)))
        _log.info("published", frames=reporter.published, reason=reason)


def _correct(source: PosedCamera, sender: CorrectionSender | None, *, final: bool = False) -> None:
    """Hand on what closed loops have changed, if anything."""
    if sender is None:
        return
    corrected = source.correction(final)
    if corrected is not None:
        sender.put(corrected)


def _send_frame(context: NodeContext, options: CameraOptions, publisher: Publisher, parts: Parts) -> bool:
    """Publish one frame, and wait for readers that must not lose any; False where a stop request came first.

    Raises:
        TransportError: a reader has had no room for it within ``ack_timeout_s``.
    """
    deadline = time.monotonic() + options.ack_timeout_s
    while not context.stop:
        try:
            publisher.publish(parts, SEND_SLICE_S)
            return True
        except TransportError as error:
            if time.monotonic() > deadline:
                raise TransportError(
                    f"camera node '{context.name}': a reader has taken no frame for {options.ack_timeout_s:g} s "
                    "(ack_timeout_s); it hangs, or needs longer than that for one frame"
                ) from error
        context.heartbeat.turn()
    return False


def _send_end(publisher: Publisher, parts: Parts) -> None:
    """Publish the end of the stream; readers without room for it now are reminded of it while the node drains."""
    with suppress(TransportError):  # the publisher keeps it for ``remind``
        publisher.publish(parts, SEND_SLICE_S)


class _StatusReporter:
    """Says once a second how the camera is, whatever the camera does, and passes the stop request on to it.

    To the launcher it tells turns of the main loop for as long as no call into the driver hangs.
    """

    def __init__(self, context: NodeContext, publisher: Publisher, note: str = "") -> None:
        self.published = 0
        self._notes = (note,) if note else ()  # of the settings; reported with the warnings
        self.waiting_for = ""  # why the camera could not be opened yet
        self.sender: CorrectionSender | None = None
        self._context = context
        self._publisher = publisher
        self._source: PosedCamera | None = None
        self._first_seq = self._last_seq = -1
        self._sent_at: float | None = None
        self._in_driver = False
        self._last_poll_time = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()
        self._tell("ended")

    @contextmanager
    def watching_driver(self) -> Iterator[None]:
        """While it is entered, only a driver that comes round counts as a turn."""
        self._in_driver = True
        try:
            yield
        finally:
            self._in_driver = False

    def watch(self, source: PosedCamera) -> None:
        """The camera is open."""
        self.waiting_for = ""
        self._source = source

    def sent(self, frame: PosedFrame) -> None:
        """A frame has been published."""
        if self._first_seq < 0:
            self._first_seq = frame.seq
        self._last_seq = frame.seq
        self.published += 1
        self._sent_at = time.monotonic()

    def _run(self) -> None:
        last_sent = 0.0
        while not self._ended.wait(POLL_S):
            source = self._source
            if self._comes_round(source):
                self._context.heartbeat.turn()
            if self._context.stop and source is not None:
                source.stop()
            if time.monotonic() - last_sent >= STATUS_PERIOD_S:
                last_sent = time.monotonic()
                self._tell(self._state())

    def _comes_round(self, source: PosedCamera | None) -> bool:
        if not self._in_driver:
            return True
        before, self._last_poll_time = self._last_poll_time, source.last_poll_time if source is not None else 0.0
        return self._last_poll_time != before

    def _state(self) -> NodeState:
        if self._context.stop:
            return "stopping"
        if self._source is None:
            return "starting"
        sender = () if self.sender is None else self.sender.warnings
        return "degraded" if self._source.warnings or sender or self._notes else "running"

    def _tell(self, state: NodeState) -> None:
        counters = {"published": self.published}
        if self._first_seq >= 0:
            counters["missing"] = self._last_seq - self._first_seq + 1 - self.published
        warnings = (self.waiting_for,) if self.waiting_for else ()
        if self._source is not None:
            counters |= self._source.counters
            warnings = self._source.warnings
        if self.sender is not None:
            counters |= self.sender.counters
            warnings = (*warnings, *self.sender.warnings)
        warnings = (*warnings, *self._notes)
        ages = {} if self._sent_at is None else {"frame": time.monotonic() - self._sent_at}
        status = Status(self._context.name, state, time.monotonic_ns(), counters, ages, warnings)
        with suppress(TransportError):  # a reader has no room for it: the next status says what this one did
            publish_status(self._publisher, status, 0.0)
