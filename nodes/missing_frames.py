"""Frames that never came, counted by the numbers of those that did."""

from __future__ import annotations

MAX_MISSED = 2**53  # numbers may jump by anything; beyond this, sums of counts would not be exact in every reader


class MissingFrames:
    """Counts the frames that are missing between others by their numbers, camera by camera.

    Attributes:
        missed: Frames, ``MAX_MISSED`` at most.
    """

    def __init__(self) -> None:
        self.missed = 0
        self.restarts = 0  # times that a camera began to count from the start: it was restarted
        self._last: dict[str, int] = {}

    def note(self, camera_id: str, seq: int) -> None:
        """A frame has come."""
        last = self._last.get(camera_id)
        self._last[camera_id] = seq
        if last is None:
            return
        if seq <= last:
            self.restarts += 1
        else:
            self.missed = min(self.missed + seq - last - 1, MAX_MISSED)
