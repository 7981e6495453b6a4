"""Frames that never came, told by the numbers of those that did."""

from __future__ import annotations

MAX_MISSED = 2**53  # numbers may jump by anything; beyond this, sums of counts would not be exact in every reader


class Gaps:
    """Counts the gaps between the numbers of frames, camera by camera.

    Attributes:
        missed: Frames, ``MAX_MISSED`` at most.
    """

    def __init__(self) -> None:
        self.missed = 0
        self.begun_anew = 0  # times that a camera began to count from the start: it was restarted
        self._last: dict[str, int] = {}

    def note(self, camera_id: str, seq: int) -> None:
        """A frame has come."""
        last = self._last.get(camera_id)
        self._last[camera_id] = seq
        if last is None:
            return
        if seq <= last:
            self.begun_anew += 1
        else:
            self.missed = min(self.missed + seq - last - 1, MAX_MISSED)
