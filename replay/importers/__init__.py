"""Foreign recordings into logs."""

from __future__ import annotations

from replay.importers.base import ImportOptions, ImportReport, Skipped
from replay.importers.run import FORMATS, detect_format, import_recording

__all__ = ["FORMATS", "ImportOptions", "ImportReport", "Skipped", "detect_format", "import_recording"]
