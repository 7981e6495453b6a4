"""Starts the nodes of a launch, watches over them, and ends them in order: camera, recorder, mapper."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import structlog

from nodes.child import Child
from nodes.launch_config import Launch
from nodes.options import NodeJob
from nodes.process import StopRequest
from semantic_mapper.errors import NodeError

POLL_S = 0.05
FOLDER_PREFIX = "semantic-mapper-"
KILL_S = 5.0  # between SIGTERM and SIGKILL for a node that has overstayed its time
STOP_ORDER = ("camera", "recorder", "mapper")  # sources first, so that the others get the end of the stream

_log = structlog.get_logger(__name__)


class Launcher:
    """The processes of one launch; a context manager that leaves none behind.

    Sockets are in a folder of their own that only this user can enter; two launches never meet.

    Args:
        launch: From ``load_launch``.
    """

    def __init__(self, launch: Launch) -> None:
        self._launch = launch
        self._children: list[Child] = []
        self._folder = Path()
        self._failures: list[str] = []

    def __enter__(self) -> Self:
        _sweep()
        self._folder = Path(tempfile.mkdtemp(prefix=f"{FOLDER_PREFIX}{os.getpid()}-"))  # mode 0700
        try:
            self._start()
        except BaseException:
            self._clean_up()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._clean_up()

    def run(self, stop: StopRequest) -> None:
        """Watch until all nodes have ended, one has failed, or a stop is requested; then end the rest in order.

        Raises:
            NodeError: a node failed, hung, or had to be killed; names it and its last words.
        """
        while not stop and not self._failures and self._sources_run():
            self._look_after_all()
            time.sleep(POLL_S)
        self._look_after_all()  # a camera that has failed since the last look
        if stop:
            _log.info("stopping", by=stop.name)
        for kind in STOP_ORDER:
            self._end(kind, stop)
        if self._failures:
            raise NodeError("; then ".join(self._failures))

    def _start(self) -> None:
        _log.info("launching", nodes=len(self._launch.nodes), sockets=str(self._folder))
        endpoints = {name: f"ipc://{self._folder}/{name}" for name in self._launch.sockets()}
        for node in self._launch.nodes:
            job = NodeJob(
                name=node.name,
                options=msgspec.to_builtins(self._launch.options[node.name]),
                endpoints=endpoints,
                subscribers=self._launch.listeners(node.name),
            )
            child = Child(node.kind, job)
            self._children.append(child)
            _log.info("node_started", node=child.name, kind=child.kind, pid=child.pid)

    def _sources_run(self) -> bool:
        """Whether a camera still runs: when none does, the others have the end of the stream and end by themselves."""
        return any(c.exit_code() is None for c in self._children if c.kind == "camera")

    def _look_after_all(self) -> None:
        for child in self._children:
            code = child.exit_code()
            if code is None and child.silent_s() > self._launch.heartbeat_s:
                child.kill()
                child.wait(KILL_S)
                self._fail(child, f"it gave no sign of life for {self._launch.heartbeat_s:g} s and was killed")
            elif child.has_failed():
                self._fail(child)

    def _end(self, kind: str, stop: StopRequest) -> None:
        """Wait for all nodes of a kind; ask them as soon as there is a reason not to wait for the end of the stream."""
        patience = self._launch.finish_s if kind == "mapper" else self._launch.stop_s
        children = [c for c in self._children if c.kind == kind]
        asked = False
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline and any(c.exit_code() is None for c in children):
            if not asked and (stop or self._failures):
                asked = True
                for child in children:
                    child.ask_to_stop()
            self._look_after_all()
            time.sleep(POLL_S)
        for child in children:
            if child.exit_code() is None:
                child.ask_to_stop()
                if not child.wait(KILL_S):
                    child.kill()
                    child.wait(KILL_S)
                self._fail(child, f"it did not end within {patience:g} s")
        self._look_after_all()

    def _fail(self, child: Child, why: str = "") -> None:
        text = child.describe_end() + (f" ({why})" if why else "")
        if not any(f.startswith(f"node '{child.name}' ") for f in self._failures):
            self._failures.append(text)
            _log.error("node_ended", node=child.name, why=why or "exit code", code=child.exit_code())

    def _clean_up(self) -> None:
        for child in self._children:
            child.close()
        self._children.clear()
        shutil.rmtree(self._folder, onerror=_tell_left_over)


def _sweep() -> None:
    """Remove the socket folders of launchers that were killed: theirs is the only name that a dead process leaves."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER_PREFIX}*-*"):
        pid = folder.name.removeprefix(FOLDER_PREFIX).partition("-")[0]
        if pid.isdigit() and not Path("/proc", pid).exists() and folder.stat().st_uid == os.getuid():
            shutil.rmtree(folder, onerror=_tell_left_over)


def _tell_left_over(function: object, path: str, error: object) -> None:
    sys.stderr.flush()
    _log.warning("left_over", path=path, error=str(error))
