"""Who has rendered the pseudo labels of a log: an attachment."""

from collections.abc import Mapping
from typing import Any

import msgspec

from semantic_mapper.replay.log.reader import LogAttachment

AUTOLABEL_ATTACHMENT = "autolabel.json"


class AutolabelNote(msgspec.Struct, frozen=True):
    """How ``autolabel`` has made a log; not when or where, so that the same run gives the same bytes."""

    weights: str  # name of the file
    digest: str  # its SHA-256
    kind: str  # of its field
    classes: tuple[str, ...]  # of the weights
    min_confidence: float  # what was requested, as the next three
    overwrite_labels: bool
    depth: bool
    max_frames: int
    frames: int  # looked at
    labelled: int  # with a pseudo label
    kept: int  # with a label that was there and is no pseudo label
    replaced: int  # labels, not pseudo labels, that gave way to pseudo labels or none
    unlabelled: int  # with no label: refused, or nothing of it is sure
    depth_written: int  # frames that got computed depth
    mean_confidence: float | None  # of the pixels with a pseudo label; None without one
    train_stamps_ns: tuple[int, ...]  # that the weights have learned from: what learns from these labels has, too
    labelled_pixels: float | None  # fraction of the pixels of frames without a label of their own; None without such

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
