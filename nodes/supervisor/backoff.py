"""How often a node may restart, and how long to wait before it does."""

from __future__ import annotations

from collections import deque

from semantic_mapper.nodes.supervisor.launch_config import NodeEntry


class RestartBackoff:
    """The failures of one node. Times are monotonic seconds.

    Args:
        entry: Its policy.
    """

    def __init__(self, entry: NodeEntry) -> None:
        self._entry = entry
        self._failures: deque[float] = deque()
        self.count = 0

    def delay_s(self, now: float) -> float | None:
        """Note a failure: seconds to wait before the next start, None where the limit is reached."""
        entry = self._entry
        self._forget_before(now - entry.window_s)
        if len(self._failures) >= entry.max_restarts:
            return None
        delay = min(entry.backoff_max_s, entry.backoff_s * 2.0 ** len(self._failures))
        self._failures.append(now)
        self.count += 1
        return delay

    def lately(self, now: float) -> int:
        """Restarts within the window."""
        self._forget_before(now - self._entry.window_s)
        return len(self._failures)

    def _forget_before(self, since: float) -> None:
        while self._failures and self._failures[0] <= since:
            self._failures.popleft()
