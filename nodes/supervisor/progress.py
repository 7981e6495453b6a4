"""Time limits for work that may be slow: they count while nothing gets on, however long all of it takes.

On a machine that has too much to do, a process of ours may wait for the processor nearly all the time. It gets on if it
says so, or if it has used the processor. What has used the processor for the whole limit, and has said nothing, has
lost its way.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import psutil

# Of the limit; a process whose main thread is stuck uses a tenth of it for its heartbeats, one of fifty that compute on
# a core uses four times as much.
_LEAST_CPU = 0.005
_LOOKS = 20  # at the processor time within the limit: reading it costs some, too


class ProgressLimit:
    """A limit on the time without progress.

    Args:
        limit_s: Seconds without a new mark and without processor time, or seconds of processor time without a new mark.
        cpu_s: Processor time of the process so far, seconds.
        clock: Seconds, monotonic.
    """

    def __init__(self, limit_s: float, cpu_s: Callable[[], float], clock: Callable[[], float] = time.monotonic) -> None:
        self._limit_s = limit_s
        self._cpu_s = cpu_s
        self._clock = clock
        self._begin(None)

    def exceeded(self, mark: object = None) -> bool:
        """Whether nothing got on for too long; to be asked often.

        Args:
            mark: What the process says of its progress: anything that is another one than before where it gets on.
        """
        now = self._clock()
        if mark != self._mark:
            self._begin(mark)
        if now < self._next_look:
            return False
        self._next_look = now + self._limit_s / _LOOKS
        cpu = self._cpu_s()
        if self._cpu_at_mark is None:
            self._cpu_at_mark = self._cpu_at_progress = cpu
        if cpu - self._cpu_at_progress >= _LEAST_CPU * self._limit_s:
            self._since, self._cpu_at_progress = now, cpu
        return now - self._since > self._limit_s or cpu - self._cpu_at_mark > self._limit_s

    def _begin(self, mark: object) -> None:
        """There is progress: limits count from now."""
        self._mark = mark
        self._since = self._clock()
        self._next_look = self._since + self._limit_s / _LOOKS
        self._cpu_at_mark: float | None = None  # read with the first look
        self._cpu_at_progress = 0.0


def cpu_seconds(pid: int) -> float:
    """Processor time of all threads so far; -1 where it cannot be read."""
    try:
        times = psutil.Process(pid).cpu_times()
    except (psutil.Error, OSError):
        return -1.0
    return times.user + times.system
