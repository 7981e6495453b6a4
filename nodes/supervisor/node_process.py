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
import structlog

from semantic_mapper.nodes.options import Call, NodeJob
from semantic_mapper.nodes.process import STOP_SIGNAL
from semantic_mapper.nodes.supervisor.heartbeat import Pulse
from semantic_mapper.nodes.supervisor.process_stats import Stillness
from semantic_mapper.nodes.supervisor.systemd import SYSTEMD_VARIABLES
from semantic_mapper.plain_text import visible

KILL_S = 5.0  # between the request to end and SIGKILL, and between SIGKILL and the end
TAIL_LINES = 12
FAILURE_EVENT = "node_failed"  # see node.py
# Of a process that somebody has asked to end, whether or not it was old enough to do so in order.
SENT_AWAY = {code: s for s in (signal.SIGTERM, signal.SIGINT) for code in (128 + s, -s)}
JOB_PREFIX = "fd:"  # of a node's argument that names an open file with its job

_log = structlog.get_logger(__name__)


class Child:
    """A running node. Its stderr is passed on line by line, marked with its name.

    Args:
        kind: Module in ``nodes`` that it runs.
        job: What it is to do (``heartbeat_fd`` is filled in here); where it ``waits``, it begins when told (``begin``).

    Raises:
        OSError: no process, thread, file or memory is to be had; nothing is left behind.
    """

    def __init__(self, kind: str, job: NodeJob) -> None:
        self.name = job.name
        self.kind = kind
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.asked_to_stop = False
        self._beats, theirs = os.pipe()
        self.pulse = Pulse(self._beats)
        try:
            self._process = _start_process(kind, job, theirs)
        except BaseException:
            os.close(self._beats)
            raise
        finally:
            os.close(theirs)
        self.stillness = Stillness(self._process.pid)
        self._reader = threading.Thread(target=self._pass_on, name=f"stderr of {self.name}", daemon=True)
        try:
            self._reader.start()
        except RuntimeError as error:
            self.close()
            raise OSError(errno.EAGAIN, f"no thread that reads what '{self.name}' says: {error}") from error

    def begin(self, call: Call) -> None:
        """Tell a process that waits to begin.

        Raises:
            OSError: it has ended.
        """
        stdin = self._process.stdin
        assert stdin is not None
        self.pulse = Pulse(self._beats)
        stdin.write(msgspec.json.encode(call) + b"\n")
        stdin.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        return self._process.poll()

    def has_failed(self) -> bool:
        """Ended otherwise than well; our request may hit a process that is too young to handle it."""
        code = self.exit_code()
        if code in (None, 0):
            return False
        return not self.asked_to_stop or (code != -STOP_SIGNAL and not self.sent_away)

    @property
    def sent_away(self) -> bool:
        """Whether it has ended because SIGTERM or SIGINT came, which are never the launcher's."""
        return self.exit_code() in SENT_AWAY

    def ask_to_stop(self) -> None:
        """``STOP_SIGNAL``, once; no matter if it has ended already."""
        if not self.asked_to_stop:
            self.asked_to_stop = True
            self._process.send_signal(STOP_SIGNAL)

    def kill(self) -> None:
        """SIGKILL; no matter if it has ended already."""
        self._process.kill()

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends within the time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Kill it if it still runs, and free what belongs to it; what does not die in time is left to the kernel."""
        if self.exit_code() is None:
            self._process.kill()
        if not self.wait(KILL_S):  # in the kernel, for a device or a disk that does not answer
            _log.error("node_does_not_die", node=self.name, pid=self.pid)
        if self._reader.is_alive():
            self._reader.join(timeout=2.0)  # a grandchild could keep the pipe open
        if self._process.stdin is not None:
            self._process.stdin.close()
        os.close(self._beats)

    def end(self) -> str:
        """How it ended: exit code or signal."""
        code = self._process.returncode
        if code in SENT_AWAY:
            return f"sent away by {SENT_AWAY[code].name} from outside the launch"
        return f"exit code {code}" if code is None or code >= 0 else f"killed by {signal.Signals(-code).name}"

    def describe_end(self) -> str:
        """How it ended, with its last words."""
        self._reader.join(timeout=2.0)
        lines = [line for line in self.tail if line.strip()]
        # A node that knows why it fails says so in one line; of any other end, all the last lines may tell.
        words = " | ".join([line for line in lines if FAILURE_EVENT in line] or lines)
        return f"node '{self.name}' ({self.kind}) ended: {self.end()}" + (f"; its last words: {words}" if words else "")

    def _pass_on(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        with stream:
            for raw in stream:
                line = visible(raw.decode(errors="replace").rstrip("\n"))
                self.tail.append(line)
                try:
                    sys.stderr.write(f"[{self.name}] {line}\n")
                    sys.stderr.flush()
                except (OSError, ValueError):  # nobody reads our stderr any more; the tail is still kept
                    continue


def _start_process(kind: str, job: NodeJob, beats: int) -> subprocess.Popen[bytes]:
    # Pipes are made here: before Python 3.12, Popen leaves those open that it made before one is not to be had.
    with ExitStack() as theirs, ExitStack() as ours:
        given = _in_memory(msgspec.json.encode(msgspec.structs.replace(job, heartbeat_fd=beats)))
        theirs.callback(os.close, given)
        output, written = os.pipe()
        ours.callback(os.close, output)
        theirs.callback(os.close, written)
        call = None
        if job.waits:
            read, call = os.pipe()
            ours.callback(os.close, call)
        else:
            read = os.open(os.devnull, os.O_RDONLY)
        theirs.callback(os.close, read)
        process = subprocess.Popen(
            # -I: a sourced workspace on PYTHONPATH, or a file in the current folder, cannot shadow our modules.
            [sys.executable, "-I", "-m", f"semantic_mapper.nodes.{kind}", f"{JOB_PREFIX}{given}"],
            stdin=read,
            stdout=written,
            stderr=subprocess.STDOUT,
            pass_fds=(beats, given),
            env={k: v for k, v in os.environ.items() if k not in SYSTEMD_VARIABLES},
            process_group=0,  # Ctrl-C in the terminal reaches the launcher only, which then stops all in order
        )
        ours.pop_all()
        process.stdout = os.fdopen(output, "rb")
        process.stdin = None if call is None else os.fdopen(call, "wb")
        return process


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
