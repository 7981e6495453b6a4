"""Signs of life: what a node tells its launcher through a pipe, and what the launcher makes of them.

Each byte is the phase that the node is in, so that a lost one does not matter, or a turn of its main loop, or a frame
that a player of logs, which publishes no status, has published. A thread writes them; where even that cannot run any
more and the launcher is gone, the kernel ends the process.
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
BEAT_PERIOD_S = 0.2
_PR_SET_PDEATHSIG = 1
_READ_BYTES = 65536


class Heart:
    """The node's end.

    Args:
        fd: Where to write; -1 = nobody listens.
        orphan_s: Without its launcher, the process has so many seconds to write its results.
    """

    def __init__(self, fd: int, orphan_s: int) -> None:
        self._fd = fd
        self._orphan_s = orphan_s
        self._phase = STARTING
        self._told_turn = 0.0
        if fd >= 0:
            os.set_blocking(fd, False)

    def start(self) -> None:
        """Begin to beat, in a thread of its own."""
        if self._fd < 0:
            return
        self.outlive_launcher()
        signal.alarm(self._orphan_s)  # here already: it may hang before the thread has begun
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()

    def outlive_launcher(self) -> None:
        """Be woken when the launcher dies: who is stopped (SIGSTOP) then would never learn of it."""
        _when_launcher_dies(signal.SIGCONT)

    def ready(self) -> None:
        """All that takes long at the start is done."""
        self._phase = RUNNING
        self._write(RUNNING)

    def turn(self) -> None:
        """The main loop has come round. Who says so once is expected to go on, until ``ending``."""
        now = time.monotonic()
        if now - self._told_turn > BEAT_PERIOD_S:
            self._told_turn = now
            self._write(TURN)

    def frame(self) -> None:
        """One more frame has been published."""
        self._write(FRAME)

    def ending(self) -> None:
        """Nothing more is awaited; results are being written."""
        self._phase = ENDING
        self._write(ENDING)

    def _write(self, sign: bytes) -> bool:
        """False where nobody can read it any more."""
        if self._fd < 0:
            return True
        try:
            os.write(self._fd, sign)
        except BlockingIOError:  # the launcher is stopped; its pipe is full
            return True
        except OSError:
            return False
        return True

    def _beat(self) -> None:
        pause = threading.Event()
        while self._write(self._phase):
            # A process whose threads cannot run is ended by the kernel, whether or not somebody watches over it.
            signal.alarm(self._orphan_s)
            pause.wait(BEAT_PERIOD_S)
        self._end_orphan()

    def _end_orphan(self) -> None:
        """Ask ourselves to stop; the kernel sees to it that nothing outlives its time, even where Python hangs."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)  # the launcher read these
        os.dup2(nowhere, 2)
        signal.alarm(self._orphan_s)
        os.kill(os.getpid(), signal.SIGTERM)


def end_with_launcher() -> None:
    """For a process that has nothing to finish yet: the kernel kills it when its launcher dies."""
    _when_launcher_dies(signal.SIGKILL)


def _when_launcher_dies(signum: signal.Signals) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signum)


class Pulse:
    """The launcher's end.

    Args:
        fd: Where to read; set to non-blocking here.

    Attributes:
        frames: Published, as far as the node tells of each.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._phase = STARTING
        self._last_sign = time.monotonic()
        self._last_turn: float | None = None
        self._last_frame: float | None = None
        self.frames = 0
        self.ready_after_s: float | None = None  # since the start
        self._began = self._last_sign
        os.set_blocking(fd, False)

    @property
    def ready(self) -> bool:
        """Whether its start-up is over."""
        return self._phase != STARTING

    @property
    def ending(self) -> bool:
        """Whether it writes its results."""
        return self._phase == ENDING

    @property
    def age_s(self) -> float:
        """Seconds since it was started."""
        return time.monotonic() - self._began

    @property
    def silent_s(self) -> float:
        """Seconds since its last sign of life."""
        return time.monotonic() - self._last_sign

    @property
    def stalled_s(self) -> float | None:
        """Seconds since the last turn of its main loop; None where none is awaited."""
        return None if self._last_turn is None or self.ending else time.monotonic() - self._last_turn

    @property
    def frame_age_s(self) -> float | None:
        """Seconds since the last frame was published; None where it tells of none."""
        return None if self._last_frame is None else time.monotonic() - self._last_frame

    def listen(self) -> None:
        """Take in what has come."""
        try:
            signs = os.read(self._fd, _READ_BYTES)
        except BlockingIOError:
            return
        if not signs:  # it has ended
            return
        self._last_sign = time.monotonic()
        if TURN in signs:
            self._last_turn = self._last_sign
        if FRAME in signs:
            self._last_frame = self._last_sign
            self.frames += signs.count(FRAME)
        phases = signs.replace(TURN, b"").replace(FRAME, b"")
        if phases:
            self._phase = phases[-1:]
        if self.ready and self.ready_after_s is None:
            self.ready_after_s = self.age_s
