"""Foreign recordings into logs."""

from __future__ import annotations

from semantic_mapper.replay.importers.base import DepthScale, ImportOptions, ImportReport, RenameConfig, Skipped
from semantic_mapper.replay.importers.run import FORMATS, detect_format, import_recording, is_recording

__all__ = [
    "FORMATS",
    "DepthScale",
    "ImportOptions",
    "ImportReport",
    "RenameConfig",
    "Skipped",
    "detect_format",
    "import_recording",
    "is_recording",
]
