"""Heartbeats of a node: written by a thread of the node into a pipe, read by its launcher.

Each byte is the phase of the node, one turn of its main loop, or one published frame (of a player of logs, which
publishes no status). A lost byte does not matter. SIGALRM ends a node whose threads cannot run any more.
"""

from __future__ import annotations

import ctypes
import os
import signal
import threading
import time

STARTING, RUNNING, ENDING = b"s", b"r", b"e"
TURN = b"t"
FRAME = b"f"
PERIOD_S = 0.2
_PR_SET_PDEATHSIG = 1
_READ_BYTES = 65536


class HeartbeatWriter:
    """The node's end of the pipe.

    Args:
        fd: Where to write; -1 = no launcher listens.
        orphan_timeout_s: Once its launcher is gone, the process has this many seconds to write its results.
    """

    def __init__(self, fd: int, orphan_timeout_s: int) -> None:
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
        _signal_when_launcher_dies(signal.SIGCONT)  # a stopped process would never learn of it
        signal.alarm(self._orphan_timeout_s)  # at once: the process may hang before the thread runs
        threading.Thread(target=self._run, name="heartbeat", daemon=True).start()

    def ready(self) -> None:
        """Start-up is over."""
        self._phase = RUNNING
        self._write(RUNNING)

    def turn(self) -> None:
        """One turn of the main loop. After the first call, more are expected until ``ending``.

        Afterwards: one more step of writing results is done.
        """
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


def end_with_launcher() -> None:
    """Be killed by the kernel when the parent process dies."""
    _signal_when_launcher_dies(signal.SIGKILL)


def _signal_when_launcher_dies(signum: signal.Signals) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signum)


class HeartbeatMonitor:
    """The launcher's end of the pipe.

    Args:
        fd: Where to read; set to non-blocking here.

    Attributes:
        frames: Published, where the node counts them.
        beats: How often something was read.
        turns: How often turns were among it: of the main loop, or steps of writing results.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._phase = STARTING
        self._started = self._last_beat = time.monotonic()
        self._last_turn: float | None = None
        self._last_frame: float | None = None
        self.frames = self.beats = self.turns = 0
        os.set_blocking(fd, False)

    @property
    def ready(self) -> bool:
        """Whether start-up is over."""
        return self._phase != STARTING

    @property
    def ending(self) -> bool:
        """Whether results are being written."""
        return self._phase == ENDING

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
        self.beats += 1
        if TURN in beats:
            self.turns += 1
            self._last_turn = self._last_beat
        if FRAME in beats:
            self._last_frame = self._last_beat
            self.frames += beats.count(FRAME)
        phases = beats.replace(TURN, b"").replace(FRAME, b"")
        if phases:
            self._phase = phases[-1:]
