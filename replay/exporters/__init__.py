"""Logs in formats of other programs."""

from semantic_mapper.replay.exporters.run import FORMATS, LogExportReport, export_log, log_format_of

__all__ = ["FORMATS", "LogExportReport", "export_log", "log_format_of"]
