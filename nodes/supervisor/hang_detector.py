"""Which process hangs, and what the kernel knows of a process."""

from __future__ import annotations

import psutil

from semantic_mapper.nodes.supervisor.heartbeat import HeartbeatMonitor
from semantic_mapper.nodes.supervisor.launch_config import Launch
from semantic_mapper.nodes.supervisor.progress import ProgressLimit, cpu_seconds

BUSY_SILENCE_S = 30.0  # loading packages may hold up all threads, and so may an overloaded machine
_ACTIVE = (psutil.STATUS_RUNNING, psutil.STATUS_DISK_SLEEP)


class HangDetector:
    """Tells a frozen process from one that is busy or waits for a processor, while both are silent.

    Args:
        pid: Of the process.
        heartbeat: Of the process.
        limits: ``heartbeat_s``, ``start_s`` and ``stall_s`` of the launch.
    """

    def __init__(self, pid: int, heartbeat: HeartbeatMonitor, limits: Launch) -> None:
        self._pid = pid
        self._heartbeat = heartbeat
        self._limits = limits
        self._cpu_s: float | None = None  # when the silence was noticed
        self._silence, self._start, self._stall = (
            ProgressLimit(limit_s, lambda: cpu_seconds(pid))
            for limit_s in (max(limits.heartbeat_s, BUSY_SILENCE_S), limits.start_s, limits.stall_s)
        )

    def find_hang(self, *, stopping: bool) -> str:
        """Why the process has to be killed; empty where it need not be.

        Args:
            stopping: It was asked to stop: start-up has no limit then.
        """
        beat, limits = self._heartbeat, self._limits
        beat.poll()
        if beat.silent_s <= limits.heartbeat_s / 2:
            self._cpu_s = None
        elif self._cpu_s is None:
            self._cpu_s = cpu_seconds(self._pid)
        running = beat.ready and not beat.ending
        frozen = running and beat.silent_s > limits.heartbeat_s and self._cpu_s is not None and self._is_frozen()
        silence_s = limits.heartbeat_s if frozen else max(limits.heartbeat_s, BUSY_SILENCE_S)
        if frozen or (self._silence.exceeded(beat.beats) and beat.silent_s > silence_s):
            return f"it gave no sign of life for {silence_s:g} s and was killed"
        if self._start.exceeded(beat.ready) and not beat.ready and not stopping and beat.age_s > limits.start_s:
            return f"it was not ready after {limits.start_s:g} s and was killed"
        stalled = self._stall.exceeded(beat.turns)
        if stalled and beat.stalled_s is not None and beat.stalled_s > limits.stall_s:
            return f"its main loop made no turn for {limits.stall_s:g} s, and it was killed"
        return ""

    def _is_frozen(self) -> bool:
        return cpu_seconds(self._pid) == self._cpu_s and not is_active(self._pid)


def is_active(pid: int) -> bool:
    """Whether a thread runs, waits for a processor, or waits for a disk."""
    try:
        return any(psutil.Process(thread.id).status() in _ACTIVE for thread in psutil.Process(pid).threads())
    except (psutil.Error, OSError):
        return False


def process_stats(pid: int) -> dict[str, int]:
    """``rss_kb``, ``cpu_ms`` (total), ``fds``, ``threads``; empty where the process has ended."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times = process.cpu_times()
            return {
                "rss_kb": process.memory_info().rss // 1024,
                "cpu_ms": round(1000 * (times.user + times.system)),
                "fds": process.num_fds(),
                "threads": process.num_threads(),
            }
    except (psutil.Error, OSError):
        return {}
