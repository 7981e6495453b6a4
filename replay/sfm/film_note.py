"""What a log keeps of the film that it was made of: an attachment."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from semantic_mapper.replay.log.reader import LogAttachment
from semantic_mapper.replay.sfm.colmap_process import Sigmas

FILM_ATTACHMENT = "film.json"


class FilmNote(msgspec.Struct, frozen=True):
    """How a film became a log.

    Args:
        frames: Of the film.
        left_out: Of these, not in the log, by reason.
        picked, registered: Frames that structure from motion was given, and has placed.
        error_px: Mean reprojection error.
        focal_px: In pixels of the film.
        sigmas: How exact the poses are; None where that cannot be told, and of older logs.
    """

    frames: int
    left_out: dict[str, int]
    picked: int
    registered: int
    error_px: float
    focal_px: float
    sigmas: Sigmas | None = None

    def attachment(self) -> LogAttachment:
        """As it stands in the log."""
        return LogAttachment(FILM_ATTACHMENT, "application/json", msgspec.json.encode(self))


def read_left_out(attachments: Mapping[str, LogAttachment]) -> int:
    """Frames of the film that are not in the log; 0 for a log that was not made of a film."""
    kept = attachments.get(FILM_ATTACHMENT)
    if kept is None:
        return 0
    try:
        return sum(msgspec.json.decode(kept.data, type=FilmNote).left_out.values())
    except msgspec.MsgspecError:  # somebody else's file of this name
        return 0
