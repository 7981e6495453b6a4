"""Where a camera that plays a log goes on after it was restarted: where the recording is by now, as a camera would."""

from __future__ import annotations

import time

from semantic_mapper.nodes.node import NodeContext

_NOTE = "began"


class Beginning:
    """When the first frame of all was published, whichever process of this camera it was.

    Args:
        context: Of the camera.
        rate: How much faster than recorded the log is played.
    """

    def __init__(self, context: NodeContext, rate: float) -> None:
        self._context = context
        self._rate = rate
        self._noted = context.note(_NOTE) if context.restarts else ""

    def due_stamp_ns(self) -> int:
        """Stamp of the recording that is due now; 0 where it has not begun."""
        if not self._noted:
            return 0
        began_ns, stamp_ns = map(int, self._noted.split())
        return stamp_ns + round((time.monotonic_ns() - began_ns) * self._rate)

    def note(self, stamp_ns: int) -> None:
        """A frame of this stamp was published; the launcher counts it, and the first of all is noted."""
        self._context.heart.frame()
        if not self._noted:
            self._noted = f"{time.monotonic_ns()} {stamp_ns}"
            self._context.try_to_leave_note(_NOTE, self._noted, "a camera that replaces it plays from the first frame")
