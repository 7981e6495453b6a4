"""One node process as its launcher sees it: started, watched, asked to stop, killed if need be."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from contextlib import ExitStack

import msgspec
import psutil
import structlog

from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.process import STOP_SIGNAL
from semantic_mapper.nodes.supervisor.fork_server import ForkServer
from semantic_mapper.nodes.supervisor.heartbeat import HeartbeatMonitor
from semantic_mapper.nodes.supervisor.process_table import PROCESS_TABLE
from semantic_mapper.nodes.supervisor.systemd import SYSTEMD_VARIABLES
from semantic_mapper.plain_text import visible
from semantic_mapper.redaction import without_secrets

KILL_S = 5.0  # between the request to end and SIGKILL, and between SIGKILL and the end
TAIL_LINES = 12
FAILURE_EVENT, LOSS_EVENT = "node_failed", "node_lost_data"  # see node.py
EXIT_LOSS = 3  # of a node that came to its end in order, but a part of what it was to keep is lost
# Of a process that somebody has asked to end, whether or not it was old enough to do so in order.
TERMINATED = {code: s for s in (signal.SIGTERM, signal.SIGINT) for code in (128 + s, -s)}
JOB_PREFIX = "fd:"  # of a node's argument that names an open file with its job

_log = structlog.get_logger(__name__)


def node_environment() -> dict[str, str]:
    """The launcher's, without what is meant for the launcher alone."""
    return {name: value for name, value in os.environ.items() if name not in SYSTEMD_VARIABLES}


class NodeProcess:
    """A running node. Its stderr is passed on line by line, marked with its name.

    Args:
        kind: A row of the process table.
        job: What it is to do (``heartbeat_fd`` is filled in here).
        server: Forks it, where its kind is preloaded; None = a new interpreter.

    Raises:
        OSError: no process, thread, file or memory is to be had; nothing is left behind.
    """

    def __init__(self, kind: str, job: NodeJob, server: ForkServer | None = None) -> None:
        self.name = job.name
        self.kind = kind
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.asked_to_stop = False
        with ExitStack() as ours, ExitStack() as theirs:
            self._beats, beats = _pipe(ours, theirs)
            self._output, output = _pipe(ours, theirs)
            given = _in_memory(msgspec.json.encode(msgspec.structs.replace(job, heartbeat_fd=beats)))
            theirs.callback(os.close, given)
            if server is not None and PROCESS_TABLE[kind].preloaded:
                self._process = server.fork(PROCESS_TABLE[kind].module, given, beats, output)
            else:
                self._process = _start_interpreter(kind, given, beats, output)
            ours.callback(self._end)
            self.heartbeat = HeartbeatMonitor(self._beats)
            self._reader = threading.Thread(target=self._pass_on, name=f"stderr of {self.name}", daemon=True)
            try:
                self._reader.start()
            except RuntimeError as error:
                raise OSError(errno.EAGAIN, f"no thread that reads what '{self.name}' says: {error}") from error
            ours.pop_all()

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        try:
            code = self._process.wait(0)
        except (subprocess.TimeoutExpired, psutil.TimeoutExpired):
            return None
        return None if code is None else int(code)

    def has_failed(self) -> bool:
        """Ended otherwise than well; our request may hit a process that is too young to handle it."""
        code = self.exit_code()
        if code in (None, 0, EXIT_LOSS):
            return False
        return not self.asked_to_stop or (code != -STOP_SIGNAL and not self.was_terminated)

    @property
    def has_lost(self) -> bool:
        """Whether it ended in order, but says that a part of what it was to keep is lost."""
        return self.exit_code() == EXIT_LOSS

    @property
    def was_terminated(self) -> bool:
        """Whether SIGTERM or SIGINT ended it, which the launcher never sends."""
        return self.exit_code() in TERMINATED

    def ask_to_stop(self) -> None:
        """``STOP_SIGNAL``, once; no matter if it has ended already."""
        if not self.asked_to_stop:
            self.asked_to_stop = True
            self._signal(STOP_SIGNAL)

    def kill(self) -> None:
        """SIGKILL; no matter if it has ended already."""
        self._signal(signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends within the time."""
        try:
            self._process.wait(timeout_s)
        except (subprocess.TimeoutExpired, psutil.TimeoutExpired):
            return False
        return True

    def close(self) -> None:
        """Kill it if it still runs, and free what belongs to it."""
        self._end()
        if self._reader.is_alive():
            self._reader.join(timeout=2.0)  # a grandchild could keep the pipe open
        os.close(self._beats)

    def describe_exit(self) -> str:
        """Exit code or signal."""
        code = self.exit_code()
        if code in TERMINATED:
            return f"sent away by {TERMINATED[code].name} from outside the launch"
        return f"exit code {code}" if code is None or code >= 0 else f"killed by {signal.Signals(-code).name}"

    def describe_end(self) -> str:
        """How it ended, with its last words."""
        self._reader.join(timeout=2.0)
        lines = [line for line in self.tail if line.strip()]
        # A node that knows why it fails says so in one line; of any other end, all the last lines may tell.
        known = [line for line in lines if FAILURE_EVENT in line or LOSS_EVENT in line]
        words = " | ".join(known or lines)
        end = f"node '{self.name}' ({self.kind}) ended: {self.describe_exit()}"
        return end + (f"; its last words: {words}" if words else "")

    def _signal(self, signum: signal.Signals) -> None:
        if self.exit_code() is None:
            self._process.send_signal(signum)

    def _end(self) -> None:
        self.kill()
        if not self.wait(KILL_S):  # in the kernel, for a device or a disk that does not answer
            _log.error("node_does_not_die", node=self.name, pid=self.pid)

    def _pass_on(self) -> None:
        with os.fdopen(self._output, "rb") as stream:
            for raw in stream:
                line = visible(without_secrets(raw.decode(errors="replace").rstrip("\n")))
                self.tail.append(line)
                try:
                    sys.stderr.write(f"[{self.name}] {line}\n")
                    sys.stderr.flush()
                except (OSError, ValueError):  # nobody reads our stderr any more; the tail is still kept
                    continue


def _pipe(ours: ExitStack, theirs: ExitStack) -> tuple[int, int]:
    read, write = os.pipe()
    ours.callback(os.close, read)
    theirs.callback(os.close, write)
    return read, write


def _start_interpreter(kind: str, job: int, heartbeat: int, output: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        # -I: a sourced workspace on PYTHONPATH, or a file in the current folder, cannot shadow our modules.
        [sys.executable, "-I", "-m", f"semantic_mapper.nodes.{kind}", f"{JOB_PREFIX}{job}"],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        pass_fds=(heartbeat, job),
        env=node_environment(),
        process_group=0,  # Ctrl-C in the terminal reaches the launcher only, which then stops all in order
    )


def _in_memory(job: bytes) -> int:
    """An open file with a job. Arguments are seen by all users (``ps``), and a camera's address may hold a password."""
    fd = os.memfd_create("job")
    try:
        with open(fd, "wb", closefd=False) as file:
            file.write(job)
        os.lseek(fd, 0, os.SEEK_SET)
    except OSError:
        os.close(fd)
        raise
    return fd
