"""The part of ``export`` that is about logs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import prepare_folder

LISTED = 10  # frames left out that are shown one by one


def export_recording(
    output: Output,
    source: Path,
    out: Path,
    format_name: str | None,
    camera: str,
    max_frames: int,
    map_options: Sequence[str],
) -> None:
    """Write a log in the format of another program, and say what was left out.

    Args:
        output: For people.
        source: Log, or a folder with the parts of one.
        out: File or folder to make.
        format_name: None = by the ending.
        camera: Empty = all.
        max_frames: 0 = all.
        map_options: Options given that mean something for maps only.

    Raises:
        ConfigError: options that do not go together.
        LogError: the log cannot be read, or the result not be written.
    """
    from semantic_mapper.replay.exporters import LogExportRequest, export_log, log_format_of

    if map_options:
        raise ConfigError(f"{', '.join(map_options)}: for saved maps only; {source} is a log")
    request = LogExportRequest(log_format_of(out, format_name), camera, max_frames)
    prepare_folder(out.parent)
    with open_log(source) as log, frame_progress("export", min(len(log), max_frames or len(log))) as bar:
        report = export_log(log, out, request, bar.advance)
        damage, notices = [str(e) for e in log.errors], list(log.notices)
    output.print(f"{out}: {counted(report.frames, 'frame')} ({request.format})")
    for notice in (*notices, *report.notices):
        output.print(f"  note: {notice}")
    lost = [*damage, *report.left_out]
    for line in lost[:LISTED]:
        output.print(f"  left out: {line}")
    if len(lost) > LISTED:
        output.print(f"  and {len(lost) - LISTED} more")
