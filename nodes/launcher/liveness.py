"""Whether a node lives, gets on or hangs: its heartbeats, and limits that count while nothing gets on.

A thread of the node writes heartbeats into a pipe; its launcher reads them. Each byte is the phase of the node, one
turn of its main loop, or one published frame (of a player of logs, which publishes no status). A lost byte does not
matter. A pipe, and not the status topic: status comes from the main loop, which may compute for a minute, and a frozen
node is to be found within a second. SIGALRM ends a node whose threads cannot run any more.
"""

import ctypes
import os
import signal
import threading
import time
from collections.abc import Callable

import psutil

STARTING, RUNNING, ENDING = b"s", b"r", b"e"
TURN, FRAME = b"t", b"f"
PERIOD_S = 0.2
START_S = STALL_S = 300.0  # until a node is ready, and for a turn of its main loop (kernels compile)
ORPHAN_TIMEOUT_S = 120  # that a node has to write its results without its launcher, or may hang
BUSY_SILENCE_S = 30.0  # loading packages may hold up all threads, and so may an overloaded machine
_PR_SET_PDEATHSIG = 1
_READ_BYTES = 65536
_ACTIVE = (psutil.STATUS_RUNNING, psutil.STATUS_DISK_SLEEP)
# Of a limit; a process whose main thread is stuck uses a tenth of it for its heartbeats, one of fifty that compute on
# a core uses four times as much.
_LEAST_CPU = 0.005


class HeartbeatWriter:
    """The node's end of the pipe ``fd``; -1 = no launcher listens."""

    def __init__(self, fd: int, orphan_timeout_s: int = ORPHAN_TIMEOUT_S) -> None:
        self._fd = fd
        self._orphan_timeout_s = orphan_timeout_s
        self._phase = STARTING
        self._last_turn = 0.0
        if fd >= 0:
            os.set_blocking(fd, False)

    def start(self) -> None:
        """Write a heartbeat every ``PERIOD_S`` from a thread."""
        if self._fd < 0:
            return
        end_with_launcher(signal.SIGCONT)  # a stopped process would never learn of it
        signal.alarm(self._orphan_timeout_s)  # at once: the process may hang before the thread runs
        threading.Thread(target=self._run, name="heartbeat", daemon=True).start()

    def ready(self) -> None:
        """Start-up is over."""
        self._phase = RUNNING
        self._write(RUNNING)

    def turn(self) -> None:
        """One turn of the main loop; after the first, more are expected until ``ending``. Then: a step of results."""
        now = time.monotonic()
        if now - self._last_turn > PERIOD_S:
            self._last_turn = now
            self._write(TURN)

    def frame(self) -> None:
        """One more frame is published."""
        self._write(FRAME)

    def ending(self) -> None:
        """The stream is over; results are being written."""
        self._phase = ENDING
        self._write(ENDING)

    def _write(self, beat: bytes) -> bool:
        """False where the launcher is gone."""
        if self._fd < 0:
            return True
        try:
            os.write(self._fd, beat)
        except BlockingIOError:  # the launcher is stopped; its pipe is full
            return True
        except OSError:
            return False
        return True

    def _run(self) -> None:
        pause = threading.Event()
        while self._write(self._phase):
            signal.alarm(self._orphan_timeout_s)  # the kernel ends a process whose threads cannot run
            pause.wait(PERIOD_S)
        self._end_orphan()

    def _end_orphan(self) -> None:
        """Request a stop; SIGALRM ends the process where that takes too long."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)  # the launcher read these
        os.dup2(null, 2)
        signal.alarm(self._orphan_timeout_s)
        os.kill(os.getpid(), signal.SIGTERM)


def end_with_launcher(signum: signal.Signals = signal.SIGKILL) -> None:
    """Be sent this signal by the kernel when the parent process dies."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signum)


class HeartbeatMonitor:
    """The launcher's end of the pipe; it distinguishes a frozen process from one that is busy or waits for a processor.

    ``heartbeat_s`` is that of the launch file.
    """

    def __init__(self, fd: int, pid: int, heartbeat_s: float) -> None:
        self._fd = fd
        self._pid = pid
        self._heartbeat_s = heartbeat_s
        self._cpu_s: float | None = None  # when the silence was noticed
        self._started = self._last_beat = time.monotonic()
        self._last_turn: float | None = None
        self._last_frame: float | None = None
        self.ready = self.ending = False  # whether start-up is over, and whether results are being written
        self.frames = 0  # published, where the node counts them
        self.turns = 0  # how often turns were among it: of the main loop, or steps of writing results
        os.set_blocking(fd, False)

    @property
    def age_s(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._started

    @property
    def silent_s(self) -> float:
        """Seconds since the last heartbeat."""
        return time.monotonic() - self._last_beat

    @property
    def stalled_s(self) -> float | None:
        """Seconds since the last turn of the main loop; None where none is expected."""
        return None if self._last_turn is None or self.ending else time.monotonic() - self._last_turn

    @property
    def frame_age_s(self) -> float | None:
        """Seconds since the last frame was published; None where the node counts none."""
        return None if self._last_frame is None else time.monotonic() - self._last_frame

    def poll(self) -> None:
        """Read what has come."""
        try:
            beats = os.read(self._fd, _READ_BYTES)
        except BlockingIOError:
            return
        if not beats:  # the process has ended
            return
        self._last_beat = time.monotonic()
        if TURN in beats:
            self.turns += 1
            self._last_turn = self._last_beat
        if FRAME in beats:
            self._last_frame = self._last_beat
            self.frames += beats.count(FRAME)
        self.ending |= ENDING in beats
        self.ready |= RUNNING in beats or self.ending

    def find_hang(self, *, stopping: bool) -> str:
        """Why the process has to be killed; empty = no need. Start-up has no limit in one that is to stop."""
        self.poll()
        frozen, busy_s = self._is_frozen(), max(self._heartbeat_s, BUSY_SILENCE_S)
        if frozen or self.silent_s > busy_s:
            return f"it gave no sign of life for {self._heartbeat_s if frozen else busy_s:g} s and was killed"
        if not self.ready and not stopping and self.age_s > START_S:
            return f"it was not ready after {START_S:g} s and was killed"
        if self.stalled_s is not None and self.stalled_s > STALL_S:
            return f"its main loop made no turn for {STALL_S:g} s, and it was killed"
        return ""

    def _is_frozen(self) -> bool:
        """Whether a node that runs is silent, and neither has had nor wants processor time meanwhile."""
        if self.silent_s <= self._heartbeat_s / 2:
            self._cpu_s = None
            return False
        if self._cpu_s is None:
            self._cpu_s = cpu_seconds(self._pid)
        is_silent = self.ready and not self.ending and self.silent_s > self._heartbeat_s
        return is_silent and cpu_seconds(self._pid) == self._cpu_s and not is_active(self._pid)


class ProgressLimit:
    """A limit on the time without progress, however long all of the work takes. ``clock`` is monotonic.

    On a machine that has too much to do, a process may wait for the processor nearly all the time. It gets on if it
    says so, or if it has used the processor. What has used the processor for the whole limit, and has said nothing, has
    lost its way.
    """

    def __init__(self, limit_s: float, cpu_s: Callable[[], float], clock: Callable[[], float] = time.monotonic) -> None:
        self._limit_s = limit_s
        self._cpu_s = cpu_s
        self._clock = clock
        self._mark: object = self  # none that a process could report
        self._since = self._cpu_at_mark = self._cpu_at_progress = 0.0

    def exceeded(self, mark: object = None) -> bool:
        """Whether nothing got on for too long; to be called often. ``mark`` is what the process says of its progress:
        anything that differs from before where it gets on."""
        now, cpu = self._clock(), self._cpu_s()
        if mark != self._mark:
            self._mark, self._since = mark, now
            self._cpu_at_mark = self._cpu_at_progress = cpu
        if cpu - self._cpu_at_progress >= _LEAST_CPU * self._limit_s:
            self._since, self._cpu_at_progress = now, cpu
        return now - self._since > self._limit_s or cpu - self._cpu_at_mark > self._limit_s


def cpu_seconds(pid: int) -> float:
    """Processor time of all threads so far; -1 where it cannot be read."""
    try:
        times = psutil.Process(pid).cpu_times()
    except (psutil.Error, OSError):
        return -1.0
    return times.user + times.system


def is_active(pid: int) -> bool:
    """Whether a thread runs, waits for a processor, or waits for a disk."""
    try:
        return any(psutil.Process(thread.id).status() in _ACTIVE for thread in psutil.Process(pid).threads())
    except (psutil.Error, OSError):
        return False
