"""The one protocol behind which every source of frames stands: cameras, rigs, and logs being played."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame


@runtime_checkable
class FrameSource(Protocol):
    """Something that gives posed frames; used as a context manager, which opens and frees the device or file.

    Iteration ends with the recording, never for a live camera. A frame that is lost or damaged is passed over, and
    shows as a gap in ``PosedFrame.seq``; a device that is gone raises the driver's error.
    """

    @property
    def info(self) -> StreamInfo:
        """Cameras with their intrinsics, the label set (None without labels), where the frames come from."""
        ...

    def __enter__(self) -> Self:
        """Open it."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free it."""
        ...

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order of capture."""
        ...
