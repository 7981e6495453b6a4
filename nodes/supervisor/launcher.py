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
from semantic_mapper.nodes.supervisor.launch_config import Launch
from semantic_mapper.nodes.supervisor.launch_note import leave_launch_note
from semantic_mapper.nodes.supervisor.launch_status import LaunchStatus
from semantic_mapper.nodes.supervisor.managed_process import Member
from semantic_mapper.nodes.supervisor.systemd import Notifier
from semantic_mapper.transport.messages import NodeState

POLL_S = 0.05
END_HEARD_S = 2.0  # after the last camera has ended, a node that was not there then will not hear of it
STOP_ORDER = ("camera", "finetuner", "recorder", "mapper")  # sources first: the others get the end of the stream
NO_END = ("finetuner",)  # hear of no end of a stream: once it is over, nobody needs them any more

_log = structlog.get_logger(__name__)


class Launcher:
    """The processes of one launch; a context manager that leaves none behind.

    Sockets are in a folder of their own that only this user can enter; two launches never meet.

    Args:
        launch: From ``load_launch``.
        notifier: Who is told how it goes, beside the status topic.
    """

    def __init__(self, launch: Launch, notifier: Notifier | None = None) -> None:
        self._launch = launch
        self._notifier = notifier or Notifier("")
        self._members: list[Member] = []
        self._told_ready = False
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
            NodeError: a node failed, hung, or had to be killed; names it and its last words.
        """
        while not stop and not self._failures() and self._sources_run():
            self._look_after_all()
            self._tell("running" if self._told_ready else "starting")
            time.sleep(POLL_S)
        self._look_after_all(last=True)  # a camera that has failed since the last look
        if stop:
            _log.info("stopping", by=stop.name)
        self._notifier.stopping(sum(map(self._patience_s, {member.kind for member in self._members})))
        for kind in STOP_ORDER:
            self._end(kind, stop)
        self._status.tell(self._members, "ended", now=True)
        if failures := self._failures():
            raise NodeError("; then ".join(failures))

    def _start(self, folder: Path) -> None:
        _log.info("launching", nodes=len(self._launch.nodes), sockets=str(folder))
        leave_launch_note(self._launch, folder)
        endpoints = {name: f"ipc://{folder}/{name}" for name in self._launch.sockets()}
        names = [n.name for n in self._launch.nodes]
        status = LaunchStatus(endpoints, names, self._launch.publish, self._launch.keys)
        self._status = self._stack.enter_context(status)
        for node in self._launch.nodes:
            self._members.append(Member(node, self._launch, endpoints, str(folder)))

    def _failures(self) -> list[str]:
        """Of nodes that are not started any more: the first one may explain the others."""
        return [m.failure for m in sorted(self._members, key=lambda m: m.failed_at) if m.failure]

    def _sources_run(self) -> bool:
        """Whether a camera still runs: when none does, the others have the end of the stream and end by themselves."""
        return any(m.runs for m in self._members if m.kind == "camera")

    def _look_after_all(self, *, last: bool = False) -> None:
        calm = all(m.state == "running" for m in self._members)
        for member in self._members:
            member.look_after(last=last, calm=calm)

    def _tell(self, state: NodeState) -> None:
        """Publish how it goes, and tell systemd."""
        self._status.tell(self._members, state)
        self._notifier.alive()
        states = {m.name: m.state for m in self._members}
        begun = set(states.values()) <= {"running", "stopping", "ended"}
        if not self._told_ready and begun and not self._failures():
            self._told_ready = True
            self._notifier.ready("all nodes are ready")
            _log.info("all_ready")
        restarts = sum(m.restarts for m in self._members)
        told = ", ".join(f"{name} {state}" for name, state in states.items())
        self._notifier.status(f"{told}; {restarts} restarts")

    def _patience_s(self, kind: str) -> float:
        # One that loads its packages still, on a busy machine, hears of a stop late.
        return self._launch.finish_s if kind in ("mapper", *NO_END) else self._launch.stop_s

    def _end(self, kind: str, stop: StopRequest) -> None:
        """Wait for all nodes of a kind; ask them as soon as there is a reason not to wait for the end of the stream."""
        patience = self._patience_s(kind)
        members = [m for m in self._members if m.kind == kind]
        began = time.monotonic()
        while time.monotonic() - began < patience:
            if kind == "mapper":  # its map was saved, the results that people look at were not
                for member in members:
                    member.start_to_finish()
            if not any(m.runs for m in members):
                break
            late = time.monotonic() - began > END_HEARD_S and any(m.restarts for m in self._members)
            for member in members:
                if stop or kind in NO_END or self._failures() or (late and member.state != "stopping"):
                    member.ask_to_stop()
            self._look_after_all(last=True)
            self._tell("stopping")
            time.sleep(POLL_S)
        for member in members:
            member.overstay(patience)
        self._look_after_all(last=True)

    def _clean_up(self) -> None:
        for member in self._members:
            member.close()
        self._members.clear()
        self._stack.close()
