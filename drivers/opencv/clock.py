"""The sender's clock of a stream, put on ours."""

from __future__ import annotations

DRIFT = 2e-4  # how much faster or slower than ours the sender's clock may run
LATE_NS = 1_000_000_000  # an image is never so much later than the quickest one: then its clock is none


class StreamClock:
    """Stamps images by the sender's clock.

    An image needs at least as long as the quickest one, so the least distance between arrival and the sender's time
    is the distance of the clocks (plus the way of that quickest image). It may grow by ``DRIFT``.
    """

    def __init__(self) -> None:
        self.trustworthy = True
        self._offset_ns: float | None = None
        self._last_arrival_ns = 0
        self._last_sent_ns = 0

    def stamp_ns(self, sent_ns: int, arrived_ns: int) -> int:
        """When an image was sent, on our clock; when it arrived, from when on the sender's clock is not one."""
        distance = float(arrived_ns - sent_ns)
        if self._offset_ns is None:
            self._offset_ns = distance
        elif sent_ns <= self._last_sent_ns:
            self.trustworthy = False
        else:
            grown = self._offset_ns + DRIFT * (arrived_ns - self._last_arrival_ns)
            self._offset_ns = min(distance, grown)
            self.trustworthy = self.trustworthy and distance - self._offset_ns < LATE_NS
        self._last_arrival_ns, self._last_sent_ns = arrived_ns, sent_ns
        return round(sent_ns + self._offset_ns) if self.trustworthy else arrived_ns
