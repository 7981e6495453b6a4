"""Who has rendered the pseudo labels of a log: an attachment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from semantic_mapper.replay.log.reader import LogAttachment

AUTOLABEL_ATTACHMENT = "autolabel.json"


class AutolabelNote(msgspec.Struct, frozen=True):
    """How ``autolabel`` has made a log. Nothing in it tells when or where, so that the same run gives the same bytes.

    Args:
        weights, digest, kind: Name of the weights file, its SHA-256, and the kind of its field.
        classes: Of the weights.
        min_confidence, overwrite_labels, depth, max_frames: What was requested.
        frames: Looked at.
        labelled: With a pseudo label.
        kept: With a label that was there and is no pseudo label.
        replaced: Labels, not pseudo labels, that gave way to pseudo labels or none.
        unlabelled: With no label: refused, or nothing of it is sure.
        depth_written: Frames that got computed or rendered depth.
        mean_confidence: Of the pixels with a pseudo label; None without one.
        labelled_pixels: Fraction of the pixels of frames without a label of their own that have got one; None without
            such frames.
        train_stamps_ns: Frames whose labels the weights have learned from: what learns from these labels has, too.
    """

    weights: str
    digest: str
    kind: str
    classes: tuple[str, ...]
    min_confidence: float
    overwrite_labels: bool
    depth: bool
    max_frames: int
    frames: int
    labelled: int
    kept: int
    replaced: int
    unlabelled: int
    depth_written: int
    mean_confidence: float | None
    train_stamps_ns: tuple[int, ...]
    labelled_pixels: float | None

    def attachment(self) -> LogAttachment:
        """As it stands in the log."""
        return LogAttachment(AUTOLABEL_ATTACHMENT, "application/json", msgspec.json.encode(self))

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return msgspec.to_builtins(self)


def read_note(attachments: Mapping[str, LogAttachment]) -> AutolabelNote | None:
    """The note of a log; None where it has none."""
    kept = attachments.get(AUTOLABEL_ATTACHMENT)
    if kept is None:
        return None
    try:
        return msgspec.json.decode(kept.data, type=AutolabelNote)
    except msgspec.MsgspecError:  # somebody else's file of this name
        return None
