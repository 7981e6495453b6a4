"""What the labelling page asks for and sends: frames of one log, and their label images in one folder."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from semantic_mapper.errors import FrameError, LabelError, LogError
from semantic_mapper.replay.label_folder import LabelFolder
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.training.strokes import grow_strokes
from semantic_mapper.types import PosedFrame

JPEG_QUALITY = 95


class ChangedElsewhereError(LabelError):
    """A label image is no longer what it was when the page showed it."""


def revision_of(label: bytes) -> str:
    """Tells one state of a label image from another."""
    return hashlib.sha256(label).hexdigest()[:32]


class LabelSession:
    """One log being labelled. Any thread may call.

    Args:
        log: Open as long as the session.
        folder: Where label images are read from and written to.
        order: Numbers of the frames to label, in the order in which the page shows them.
    """

    def __init__(self, log: Log, folder: LabelFolder, order: Sequence[int]) -> None:
        self._log, self._folder, self._order = log, folder, list(order)
        self._sizes: dict[int, tuple[int, int]] = {}
        self._lock = threading.Lock()

    def describe(self) -> dict[str, Any]:
        """What the page shows: plain data."""
        labels = self._folder.label_set
        classes = zip(labels.ids, labels.names, labels.colors, strict=True)
        return {
            "log": self._log.path.name,
            "folder": str(self._folder.path),
            "frames": len(self._log),
            "order": self._order,
            "labelled": self._folder.numbers(),
            "ignore": labels.ignore_id,
            "classes": [{"id": i, "name": name, "color": list(color)} for i, name, color in classes],
        }

    def image(self, number: int) -> bytes:
        """Colour image of a frame, as JPEG.

        Raises:
            LogError, FrameError: no such frame, or a damaged one.
        """
        with self._lock:
            frame = self._frame(number)
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        return cv2.imencode(".jpg", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), options)[1].tobytes()

    def label(self, number: int) -> bytes:
        """Class ids of a frame's pixels, row by row, a byte each; the ignore id where nothing is labelled.

        Raises:
            LogError, FrameError: no such frame, a damaged one, or a damaged label image.
        """
        with self._lock:
            return self._label(number)

    def grown(self, number: int) -> bytes:
        """What the strokes of a frame grow to, in the form of ``label``.

        Raises:
            LogError, FrameError: as ``label``.
        """
        label_set = self._folder.label_set
        with self._lock:
            frame = self._frame(number)
            label = np.frombuffer(self._label(number), np.uint8).reshape(self._size(number))
        grown = grow_strokes(replace(frame, label=label), label_set).label
        assert grown is not None
        return grown.tobytes()

    def _label(self, number: int) -> bytes:
        size = self._size(number)
        if number in self._folder.numbers():
            return self._folder.read(number, size).tobytes()
        return np.full(size, self._folder.label_set.ignore_id, np.uint8).tobytes()

    def save(self, number: int, data: bytes, revision: str | None = None) -> None:
        """Write what ``label`` gives, as changed by a person.

        Args:
            number: Of the frame.
            data: Class ids.
            revision: ``revision_of`` what the person changed; None = whatever is there is replaced.

        Raises:
            ChangedElsewhereError: somebody else has changed it since.
            LabelError: not a byte a pixel, or an id that is no class.
            LogError, FrameError: no such frame, or it cannot be written.
        """
        with self._lock:
            height, width = self._size(number)
            if len(data) != height * width:
                raise LabelError(
                    f"frame {number}: {len(data):,} bytes came for {width}x{height} pixels; send one class id a pixel"
                )
            if revision is not None and revision != revision_of(self._label(number)):
                raise ChangedElsewhereError(f"frame {number} was changed elsewhere, in another tab or by a program")
            self._folder.write(number, np.frombuffer(data, np.uint8).reshape(height, width))

    def pixels(self, number: int) -> int:
        """How many a frame has: bytes of its label.

        Raises:
            LogError, FrameError: no such frame, or a damaged one.
        """
        with self._lock:
            height, width = self._size(number)
        return height * width

    def _size(self, number: int) -> tuple[int, int]:
        if number not in self._sizes:
            self._frame(number)
        return self._sizes[number]

    def _frame(self, number: int) -> PosedFrame:
        if not 0 <= number < len(self._log):
            raise LogError(f"{self._log.path}: has no frame {number}; it has {len(self._log)}")
        frame = self._log.frame(number)
        self._sizes[number] = frame.intrinsics.height, frame.intrinsics.width
        return frame


SESSION_ERRORS = (LabelError, LogError, FrameError)
