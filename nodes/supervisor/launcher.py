"""Starts the nodes of a launch, watches over them, and ends them in order: camera, finetuner, recorder, mapper."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import structlog

from semantic_mapper.errors import NodeError
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.process_folder import OwnFolder, sweep
from semantic_mapper.nodes.supervisor.fork_server import ForkServer
from semantic_mapper.nodes.supervisor.launch_config import Launch
from semantic_mapper.nodes.supervisor.launch_note import leave_launch_note
from semantic_mapper.nodes.supervisor.launch_status import LaunchStatus
from semantic_mapper.nodes.supervisor.managed_process import ManagedProcess
from semantic_mapper.nodes.supervisor.node_process import node_environment
from semantic_mapper.nodes.supervisor.process_table import PROCESS_TABLE
from semantic_mapper.nodes.supervisor.systemd import Notifier
from semantic_mapper.transport.messages import NodeState

POLL_S = 0.05
END_HEARD_S = 2.0  # after the last camera has ended, a node that was not there then will not hear of it

_log = structlog.get_logger(__name__)


class Launcher:
    """The processes of one launch; a context manager that leaves none behind.

    Sockets are in a folder of their own that only this user can enter; two launches never meet.

    Args:
        launch: From ``load_launch``.
        notifier: Receives the state of the launch, beside the status topic.
    """

    def __init__(self, launch: Launch, notifier: Notifier | None = None) -> None:
        self._launch = launch
        self._notifier = notifier or Notifier("")
        self._processes: list[ManagedProcess] = []
        self._reported_ready = False
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        sweep()
        folder = OwnFolder()
        self._stack.callback(folder.close)  # last of all
        try:
            self._start(folder.path)
        except BaseException:
            self._clean_up()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clean_up()

    def run(self, stop: StopRequest) -> None:
        """Watch until all nodes have ended, one has failed for good, or a stop is requested; then end all in order.

        Raises:
            NodeError: a node failed, hung, had to be killed, or says at its end what it has lost; names it and its
                last words.
        """
        while not stop and not self._failures() and self._sources_run():
            self._look_after_all()
            self._report("running" if self._reported_ready else "starting")
            time.sleep(POLL_S)
        self._look_after_all(last=True)  # a camera that has failed since the last look
        if stop:
            _log.info("stopping", by=stop.name)
        for kind in PROCESS_TABLE:
            self._end(kind, stop)
        self._status.report(self._processes, "ended", now=True)
        if failures := self._failures() + [p.loss for p in self._processes if p.loss and not p.failure]:
            raise NodeError("; then ".join(failures))

    def _start(self, folder: Path) -> None:
        _log.info("launching", nodes=len(self._launch.nodes), sockets=str(folder))
        leave_launch_note(self._launch, folder)
        endpoints = {name: f"ipc://{folder}/{name}" for name in self._launch.sockets()}
        names = [n.name for n in self._launch.nodes]
        status = LaunchStatus(endpoints, names, self._launch.publish, self._launch.keys)
        self._status = self._stack.enter_context(status)
        server = ForkServer(node_environment())
        self._stack.callback(server.close)
        for node in self._launch.nodes:
            self._processes.append(ManagedProcess(node, self._launch, endpoints, str(folder), server))

    def _failures(self) -> list[str]:
        """Of nodes that are not started any more: the first one may explain the others."""
        return [p.failure for p in sorted(self._processes, key=lambda p: p.failed_at) if p.failure]

    def _sources_run(self) -> bool:
        """Whether a camera still runs: when none does, the others have the end of the stream and end by themselves."""
        return any(p.runs for p in self._processes if p.kind == "camera")

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
        restarts = sum(p.restarts for p in self._processes)
        nodes = ", ".join(f"{name} {state}" for name, state in states.items())
        self._notifier.status(f"{nodes}; {restarts} restarts")

    def _stop_s(self) -> float:
        """How long the end of all may take without progress."""
        return sum(map(self._stop_limit_s, {process.kind for process in self._processes}))

    def _stop_limit_s(self, kind: str) -> float:
        return getattr(self._launch, PROCESS_TABLE[kind].stop_limit)

    def _end(self, kind: str, stop: StopRequest) -> None:
        """Wait for all nodes of a kind; ask them as soon as there is a reason not to wait for the end of the stream.

        Only one that does not get on any more is killed: on a starved machine, results take their time.
        """
        limit_s = self._stop_limit_s(kind)
        processes = [p for p in self._processes if p.kind == kind]
        began = time.monotonic()
        while True:
            if kind == "mapper":  # its map was saved, the results that people look at were not
                for process in processes:
                    process.start_to_finish()
            get_on = [p.gets_on(limit_s) for p in processes]  # of all: limits begin now
            if not any(get_on):
                break
            self._notifier.stopping(self._stop_s())
            late = time.monotonic() - began > END_HEARD_S and any(p.restarts for p in self._processes)
            hears_no_end = bool(stop or self._failures()) or not PROCESS_TABLE[kind].ends_with_stream
            for process in processes:
                if hears_no_end or (late and process.state != "stopping"):
                    process.ask_to_stop()
            self._look_after_all(last=True)
            self._report("stopping")
            time.sleep(POLL_S)
        for process in processes:
            process.overstay(limit_s)
        self._look_after_all(last=True)

    def _clean_up(self) -> None:
        for process in self._processes:
            process.close()
        self._processes.clear()
        self._stack.close()
