"""Starts the nodes of a launch, watches over them, ends them in order, and publishes how each of them is."""

import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import psutil
import structlog
from msgspec.structs import replace

from semantic_mapper.errors import CodecError, NodeError, TransportError
from semantic_mapper.nodes.launcher.launch_file import Launch
from semantic_mapper.nodes.launcher.processes import STOP_S, ManagedProcess
from semantic_mapper.nodes.launcher.running import leave_launch_note
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.publishing import PublicPublisher
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.launches import STATUS_SOCKET
from semantic_mapper.transport.messages import NodeState, Status
from semantic_mapper.transport.process_folder import OwnFolder, sweep
from semantic_mapper.transport.sockets import NewestSubscriber

POLL_S = 0.05
STATUS_PERIOD_S = 0.5
MAX_SENTENCE, MAX_SENTENCES = 400, 32  # last words of a node may be long
END_HEARD_S = 2.0  # after the last camera has ended, a node that was not there then will not hear of it

_log = structlog.get_logger(__name__)


class Notifier:
    """Tells systemd the state of the service (sd_notify). What cannot be sent is logged once.

    ``address`` is the path of the socket, "@name" for an abstract one, empty for none; ``watchdog_s`` how often systemd
    wants a sign of life, at least, 0 for never.
    """

    def __init__(self, address: str, watchdog_s: float = 0.0) -> None:
        self._address = address.replace("@", "\0", 1) if address.startswith("@") else address
        self._watchdog_s = watchdog_s
        self._last_sign = self._extended_at = float("-inf")
        self._last_status = ""
        self._failed = False

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> "Notifier":
        """As systemd has set it up; a watchdog may be meant for another process."""
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        ours = usec.isdigit() and pid in ("", str(os.getpid()))
        return cls(environment.get("NOTIFY_SOCKET", ""), int(usec) / 1e6 if ours else 0.0)

    def ready(self, status: str) -> None:
        """Start-up is over."""
        self._send("READY=1")
        self.status(status)

    def stopping(self, extend_s: float) -> None:
        """The end has begun, and may take so long from now; to be called in a loop."""
        if time.monotonic() - self._extended_at < min(1.0, extend_s / 3):
            return
        self._extended_at = time.monotonic()
        self._send(f"STOPPING=1\nEXTEND_TIMEOUT_USEC={round(extend_s * 1e6)}")

    def status(self, text: str) -> None:
        """One line for ``systemctl status``; sent when it changes."""
        if text != self._last_status:
            self._last_status = text
            self._send(f"STATUS={text}")

    def alive(self) -> None:
        """A sign of life, as often as the watchdog asks for; to be called in a loop."""
        now = time.monotonic()
        if self._watchdog_s and now - self._last_sign >= self._watchdog_s / 3:
            self._last_sign = now
            self._send("WATCHDOG=1")

    def _send(self, message: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
                sender.sendto(message.encode(), self._address)
        except OSError as error:
            if not self._failed:
                _log.warning("systemd_not_reached", what=message.split("\n")[0], reason=str(error))
            self._failed = True


class Launcher:
    """The processes of one launch; a context manager that leaves none behind.

    Sockets are in a folder of their own that only this user can enter; two launches never meet. ``notifier`` receives
    the state of the launch, in addition to the status topic; ``on_ready`` is called with the folder of its sockets once
    all nodes are ready.
    """

    def __init__(
        self, launch: Launch, notifier: Notifier | None = None, on_ready: Callable[[Path], None] = lambda folder: None
    ) -> None:
        self._launch = launch
        self._notifier = notifier or Notifier("")
        self._on_ready = on_ready
        self._processes: list[ManagedProcess] = []
        self._reported_ready = False
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        sweep()
        folder = OwnFolder()
        self._folder = folder.path
        self._stack.callback(folder.close)  # last of all
        endpoints = {name: f"ipc://{folder.path}/{name}" for name in self._launch.sockets()}
        _log.info("launching", nodes=len(self._launch.nodes), sockets=str(folder.path))
        try:
            leave_launch_note(self._launch, folder.path)
            self._status = LaunchStatus(self._stack, endpoints, self._launch)
            for node in self._launch.nodes:
                self._processes.append(ManagedProcess(node, self._launch, endpoints, str(folder.path)))
        except BaseException:
            self._clean_up()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._clean_up()

    def run(self, stop: StopRequest) -> None:
        """Watch until all nodes have ended, one has failed for good, or a stop is requested; then end all in order.

        Raises NodeError: a node failed, hung, had to be killed, or says at its end what it has lost; names it and its
        last words.
        """
        # When no camera runs, the others have the end of the stream and end by themselves.
        while not stop and not self._failures() and any(p.runs for p in self._processes if p.kind == "camera"):
            self._look_after_all()
            self._report("running" if self._reported_ready else "starting")
            time.sleep(POLL_S)
        self._look_after_all(last=True)  # a camera that has failed since the last look
        if stop:
            _log.info("stopping", by=stop.name)
        for kind in STOP_S:
            self._end(kind, stop)
        self._status.report(self._processes, "ended", now=True)
        if failures := self._failures() + [p.loss for p in self._processes if p.loss and not p.failure]:
            raise NodeError("; then ".join(failures))

    def _failures(self) -> list[str]:
        """Of nodes that are not started any more: the first one may explain the others."""
        return [p.failure for p in sorted(self._processes, key=lambda p: p.failed_at) if p.failure]

    def _look_after_all(self, *, last: bool = False) -> None:
        for process in self._processes:
            process.look_after(last=last)

    def _report(self, state: NodeState) -> None:
        """Publish the state of all nodes, and notify systemd."""
        self._status.report(self._processes, state)
        self._notifier.alive()
        states = {p.name: p.state for p in self._processes}
        begun = set(states.values()) <= {"running", "stopping", "ended"}
        if not self._reported_ready and begun and not self._failures():
            self._reported_ready = True
            self._notifier.ready("all nodes are ready")
            _log.info("all_ready")
            self._on_ready(self._folder)
        restarts = sum(p.restarts for p in self._processes)
        nodes = ", ".join(f"{name} {state}" for name, state in states.items())
        self._notifier.status(f"{nodes}; {restarts} restarts")

    def _end(self, kind: str, stop: StopRequest) -> None:
        """Wait for all nodes of a kind; request a stop once there is a reason not to wait for the end of the stream.

        Only one that makes no more progress is killed: on a starved machine, results take their time.
        """
        limit_s = STOP_S[kind]
        processes = [p for p in self._processes if p.kind == kind]
        began = time.monotonic()
        while True:
            if kind == "mapper":  # its map was saved, the results that people look at were not
                for process in processes:
                    process.start_to_finish()
            progress = [p.makes_progress(limit_s) for p in processes]  # of all: limits begin now
            if not any(progress):
                break
            self._notifier.stopping(sum(STOP_S[k] for k in {p.kind for p in self._processes}))
            late = time.monotonic() - began > END_HEARD_S and any(p.restarts for p in self._processes)
            hears_no_end = bool(stop or self._failures()) or kind == "finetuner"
            for process in processes:
                if hears_no_end or (late and process.state != "stopping"):
                    process.request_stop()
            self._look_after_all(last=True)
            self._report("stopping")
            time.sleep(POLL_S)
        for process in processes:
            process.kill_overdue(limit_s)
        self._look_after_all(last=True)

    def _clean_up(self) -> None:
        for process in self._processes:
            process.close()
        self._processes.clear()
        self._stack.close()


class LaunchStatus:
    """Publishes a ``Status`` of each node, and one of the launch itself.

    Counters and ages of a node's own status are passed on (a player of logs has none: its launcher counts ``published``
    frames). Added are ``pid``, ``restarts``, ``rss_kb``, ``cpu_ms`` and ``fds``, and the ages ``start`` (of the
    process), ``beat`` (last heartbeat), ``turn`` (of its main loop) and ``status`` (of its own status). Raises
    TransportError: the endpoint cannot be bound.
    """

    def __init__(self, stack: ExitStack, endpoints: Mapping[str, str], launch: Launch) -> None:
        self._began = time.monotonic()
        self._reported_at = 0.0
        self._own: dict[str, Status] = {}
        own, file, nodes = endpoints[STATUS_SOCKET], launch.file, [endpoints[node.name] for node in launch.nodes]
        self._publisher = stack.enter_context(PublicPublisher(own, file.publish, file.keys, linger_ms=200))
        self._subscriber = stack.enter_context(NewestSubscriber(nodes, ("status",)))

    def report(self, processes: Sequence[ManagedProcess], state: NodeState, *, now: bool = False) -> None:
        """Publish, if it is time to."""
        if not now and time.monotonic() - self._reported_at < STATUS_PERIOD_S:
            return
        self._reported_at = time.monotonic()
        while (message := self._subscriber.receive(0.0)) is not None:
            if isinstance(message, Status):
                self._own[message.node] = message
        statuses = [node_status(managed, self._own.get(managed.name)) for managed in processes]
        degraded = tuple(f"node '{s.node}' is not well" for s in statuses if s.degraded)
        counters = {"pid": os.getpid(), "nodes": len(processes), "restarts": sum(m.restarts for m in processes)}
        shown: NodeState = "degraded" if degraded and state == "running" else state
        ages_s = {"start": time.monotonic() - self._began}
        counters |= process_stats(os.getpid())
        statuses.append(Status(STATUS_SOCKET, shown, time.monotonic_ns(), counters, ages_s, degraded))
        for status in statuses:
            short = tuple(sentence[:MAX_SENTENCE] for sentence in status.degraded[:MAX_SENTENCES])
            try:
                self._publisher.publish(encode(replace(status, degraded=short)))
            except (CodecError, TransportError) as error:  # no reason to end a launch
                _log.warning("status_not_sent", node=status.node, reason=str(error))


def node_status(managed: ManagedProcess, own: Status | None) -> Status:
    """What a node says of itself (unless the process that said it is gone) and what its launcher knows."""
    now = time.monotonic_ns()
    counters = {"restarts": managed.restarts}
    ages: dict[str, float] = {}
    degraded = managed.warnings
    if managed.process is not None:
        beat = managed.process.heartbeat
        ages |= {"start": beat.age_s, "beat": beat.silent_s}
        if beat.stalled_s is not None:
            ages["turn"] = beat.stalled_s
        counters |= {"pid": managed.process.pid} | process_stats(managed.process.pid)
        if beat.frame_age_s is not None:
            counters["published"], ages["frame"] = beat.frames, beat.frame_age_s
        if own is not None and (now - own.stamp_ns) / 1e9 <= beat.age_s:
            said_s = (now - own.stamp_ns) / 1e9
            ages = {name: age + said_s for name, age in own.ages_s.items()} | ages | {"status": said_s}
            counters = dict(own.counters) | counters
            degraded += own.degraded
    state: NodeState = "degraded" if degraded and managed.state == "running" else managed.state
    return Status(managed.name, state, now, counters, ages, degraded)


def process_stats(pid: int) -> dict[str, int]:
    """``rss_kb``, ``cpu_ms`` (total), ``fds``; empty where the process has ended."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times = process.cpu_times()
            return {
                "rss_kb": process.memory_info().rss // 1024,
                "cpu_ms": round(1000 * (times.user + times.system)),
                "fds": process.num_fds(),
            }
    except (psutil.Error, OSError):
        return {}
