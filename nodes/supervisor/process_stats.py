"""What the kernel knows of a process: memory, processor time, open files, threads."""

from __future__ import annotations

import os
from pathlib import Path

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_TICK_MS = 1000 // os.sysconf("SC_CLK_TCK")


def process_figures(pid: int) -> dict[str, int]:
    """``rss_kb``, ``cpu_ms`` (total), ``fds``, ``threads``; empty where the process has ended."""
    try:
        resident = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
        # The name may hold anything; after its bracket come: state, ppid, ..., utime (11), stime (12), threads (17).
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        files = len(os.listdir(f"/proc/{pid}/fd"))
    except (OSError, IndexError):
        return {}
    return {
        "rss_kb": resident * _PAGE_BYTES // 1024,
        "cpu_ms": (int(fields[11]) + int(fields[12])) * _TICK_MS,
        "fds": files,
        "threads": int(fields[17]),
    }


class Stillness:
    """Tells a process that is frozen from one that is busy or waits for a processor, while both are silent.

    Args:
        pid: Of the process.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._ticks: int | None = None  # when it began to be watched

    def watch(self) -> None:
        """Begin, where it has not been begun."""
        if self._ticks is None:
            self._ticks = _ticks(self._pid)

    def forget(self) -> None:
        """It has given a sign of life."""
        self._ticks = None

    @property
    def proven(self) -> bool:
        """Whether it has had no processor time since, and asks for none now."""
        return self._ticks is not None and self._ticks == _ticks(self._pid) and not _runnable(self._pid)


def _ticks(pid: int) -> int:
    """Processor time of all threads so far; -1 where it cannot be read."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return -1
    return int(fields[11]) + int(fields[12])


def _runnable(pid: int) -> bool:
    """Whether a thread runs, waits for its turn, or waits for a disk."""
    try:
        states = [
            (task / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
            for task in Path(f"/proc/{pid}/task").iterdir()
        ]
    except OSError:
        return False
    return any(state in "RD" for state in states)
