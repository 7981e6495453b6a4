"""The camera node over a camera: posed frames go out, and its warnings with them.

Frames of a live camera are dropped rather than held back; those of a video file wait for their readers.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Self

import structlog

from semantic_mapper.config import convert_config
from semantic_mapper.drivers.base import Camera
from semantic_mapper.drivers.poses.config import PoseChecks, begins_world, can_be_found, gives_metres, mount_for
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import make_poses, read_pose_config
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.errors import CameraError, ConfigError, TransportError
from semantic_mapper.nodes.camera.corrections import CorrectionSender, without_loops
from semantic_mapper.nodes.camera.listeners import drain, wait_for_listeners
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import CameraOptions, LiveCamera, table_of
from semantic_mapper.nodes.publishing import PartStatus, StatusReport
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import EndOfStream, EndReason, NodeState
from semantic_mapper.transport.sockets import Publisher
from semantic_mapper.types import PosedFrame

POLL_S = 0.05  # how soon a stop request is passed on
SEND_SLICE_S = 0.2  # between two looks at whether to stop, while a reader has no room for the next frame
FIRST_PAUSE_S = 0.2  # before a camera that could not be opened is tried again; doubles each time
MAX_PAUSE_S = 2.0

_log = structlog.get_logger(__name__)


def run_live_camera(context: NodeContext, options: CameraOptions, live: LiveCamera) -> None:
    """Publish a camera's frames until it ends (a video) or somebody asks to stop.

    Raises ConfigError: of the camera or of the poses: unknown keys, wrong values; or the node is to be restarted, and
    the world of its poses would be another one then. CameraError: the camera can never work with its config, or was not
    there within ``open_s``. DependencyError: the kind needs something that is not installed. TransportError: the
    endpoint is taken.
    """
    policy = "block" if make_source(live).can_wait else "drop"  # mistakes in the config are found here, before any wait
    if context.restartable:
        check_world(context.name, live)
    live, note = (live, "") if options.corrections else without_loops(live)
    with (
        Publisher(context.endpoint(context.name), policy=policy) as publisher,
        _LiveNode(context, options, publisher, note) as node,
    ):
        context.heartbeat.ready()  # a camera may be plugged in much later
        with ExitStack() as stack:
            source = node.open(live, stack)
            if source is None:
                return
            try:
                wait_for_listeners(context, publisher)
            except TransportError as error:  # a camera does not end because one of them does not come
                _log.warning("some_do_not_listen", reason=str(error))
            if options.corrections:
                endpoint = context.endpoint(options.corrections)
                node.sender = stack.enter_context(CorrectionSender(endpoint, live.id))
            node.publish_all(source)
        context.heartbeat.ending()
        drain(context, publisher)


def check_world(name: str, live: LiveCamera) -> None:
    """Refuse (``ConfigError``) to restart a camera without depth that tracks itself: the map cannot find it again."""
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
    """The camera with its poses, not open yet; errors as of ``run_live_camera``."""
    config, where = table_of(live.config, "camera.config")
    return with_poses(open_camera(live.kind, config, live.id, where), live, config)


def with_poses(camera: Camera, live: LiveCamera, driver: dict[str, Any]) -> PosedCamera:
    """A camera whose frames get their poses from the source that a config names; its ``checks`` say what is refused."""
    config = dict(table_of(live.poses, "camera.poses")[0])
    checks = convert_config(config.pop("checks", {}), PoseChecks, "poses: checks")
    poses = read_pose_config(config)
    mount = mount_for(poses, live.T_rig_camera, live.kind, driver, f"camera '{live.id}'")
    return PosedCamera(camera, make_poses(poses), checks, T_rig_camera=mount, scale_known=gives_metres(poses))


class _LiveNode:
    """Publishes the frames; a second thread says once a second how the camera is, whatever the camera does, and passes
    the stop request on to it.

    To the launcher it tells turns of the main loop for as long as no call into the driver hangs.
    """

    def __init__(self, context: NodeContext, options: CameraOptions, publisher: Publisher, note: str) -> None:
        self.sender: CorrectionSender | None = None  # takes closed loops to the mapper
        self._context = context
        self._options = options
        self._publisher = publisher
        self._status = StatusReport(context.name, publisher)
        self._note = note  # of the settings; reported with the warnings
        self._waiting_for = ""  # why the camera could not be opened yet
        self._source: PosedCamera | None = None  # once it is open
        self._published = 0
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
        self._report("ended")

    def open(self, live: LiveCamera, stack: ExitStack) -> PosedCamera | None:
        """An open source, which ``stack`` closes; None where a stop request came first. Raises CameraError: it could
        not be opened within ``live.open_s``."""
        began, pause_s = time.monotonic(), FIRST_PAUSE_S
        while not self._context.stop:
            source = make_source(live)
            try:
                with self._watching_driver():
                    stack.enter_context(source)
            except CameraError as error:
                if live.open_s and time.monotonic() - began > live.open_s:
                    raise
                if str(error) != self._waiting_for:
                    _log.warning("camera_not_open", reason=str(error))
                self._waiting_for = str(error)
            else:
                self._waiting_for = ""
                self._source = source
                return source
            deadline, pause_s = time.monotonic() + pause_s, min(2 * pause_s, MAX_PAUSE_S)
            while not self._context.stop and time.monotonic() < deadline:
                time.sleep(POLL_S)
        return None

    def publish_all(self, source: PosedCamera) -> None:
        """Publish frames to the end of the source, or until a stop request, and the end of the stream.

        Raises CameraError: the camera has failed. TransportError: a reader that must not lose any has taken no frame
        for ``ack_timeout_s``.
        """
        context, publisher = self._context, self._publisher
        publisher.publish(encode(source.info, sender=context.name))
        _log.info("publishing", source=source.info.source)
        reason: EndReason = "error"
        detail = "the camera node failed"
        try:
            with self._watching_driver():
                for frame in source:
                    if context.stop or not self._send(frame):
                        break
                    self._correct(source)
                    if self._options.max_frames and self._published >= self._options.max_frames:
                        break
                self._correct(source, final=True)
            reason, detail = ("stopped" if context.stop else "end"), ""
        except CameraError as error:
            detail = str(error)
            raise
        finally:
            if reason != "error" or not context.restartable:  # else the stream goes on with the process after this one
                with suppress(TransportError):  # who has no room for it now is reminded while the node drains
                    end = EndOfStream(context.name, reason, self._published, detail)
                    publisher.publish(encode(end), SEND_SLICE_S)
            _log.info("published", frames=self._published, reason=reason)

    def _correct(self, source: PosedCamera, *, final: bool = False) -> None:
        """Hand on what closed loops have changed, if anything."""
        if self.sender is not None and (corrected := source.correction(final)) is not None:
            self.sender.put(corrected)

    def _send(self, frame: PosedFrame) -> bool:
        """Publish one frame, and wait for readers that must not lose any; False where a stop request came first."""
        parts = encode_frame(frame)
        deadline = time.monotonic() + self._options.ack_timeout_s
        while not self._context.stop:
            try:
                self._publisher.publish(parts, SEND_SLICE_S)
            except TransportError as error:
                if time.monotonic() > deadline:
                    raise TransportError(
                        f"camera node '{self._context.name}': a reader has taken no frame for "
                        f"{self._options.ack_timeout_s:g} s (ack_timeout_s); it hangs, or needs longer than that"
                    ) from error
                self._context.heartbeat.turn()
                continue
            self._first_seq = frame.seq if self._first_seq < 0 else self._first_seq
            self._last_seq = frame.seq
            self._published += 1
            self._sent_at = time.monotonic()
            return True
        return False

    @contextmanager
    def _watching_driver(self) -> Iterator[None]:
        """While it is entered, only a driver that comes round counts as a turn."""
        self._in_driver = True
        try:
            yield
        finally:
            self._in_driver = False

    def _run(self) -> None:
        while not self._ended.wait(POLL_S):
            source = self._source
            before, self._last_poll_time = self._last_poll_time, 0.0 if source is None else source.last_poll_time
            if not self._in_driver or self._last_poll_time != before:
                self._context.heartbeat.turn()
            if self._context.stop and source is not None:
                source.stop()
            if self._status.due:
                running: NodeState = "degraded" if self._warnings() else "running"
                self._report("stopping" if self._context.stop else "starting" if source is None else running)

    def _warnings(self) -> tuple[str, ...]:
        own = self._source.warnings if self._source is not None else (self._waiting_for,)
        sender = () if self.sender is None else self.sender.status().warnings
        return tuple(text for text in (*own, *sender, self._note) if text)

    def _report(self, state: NodeState) -> None:
        counters = {"published": self._published}
        if self._first_seq >= 0:
            counters["missing"] = self._last_seq - self._first_seq + 1 - self._published
        counters |= {} if self._source is None else self._source.counters
        counters |= {} if self.sender is None else self.sender.status().counters
        ages = {} if self._sent_at is None else {"frame": time.monotonic() - self._sent_at}
        with suppress(TransportError):  # a reader has no room for it: the next status says what this one did
            self._status.publish(state, PartStatus(counters, self._warnings(), ages), timeout_s=0.0)
