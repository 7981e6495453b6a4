"""What the verbs ``import`` and ``map`` say of a recording that has become a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from semantic_mapper.nodes.console import Output
from semantic_mapper.plain_text import counted

if TYPE_CHECKING:
    from semantic_mapper.replay.importers import ImportReport

LISTED = 10  # skipped files that are shown one by one


def print_import(output: Output, report: ImportReport, log: Path) -> None:
    """Frames, depth, what had to be assumed, and what was left out and why."""
    labels = "no labels" if not report.labelled else f"{report.labelled} of them labelled"
    output.print(
        f"{log}: {counted(report.frames, 'frame')} ({labels}), {report.bytes / 1e6:.1f} MB, from a '{report.format}'"
    )
    output.print(f"  depth: {_depth_line(report)}")
    for notice in report.notices:
        output.print(f"  note: {notice}")
    for skipped in report.skipped[:LISTED]:
        what = "label left out" if skipped.label_only else "frame left out"
        output.print(f"  {what}: frame {skipped.frame}: {skipped.file}: {skipped.reason}")
    if len(report.skipped) > LISTED:
        output.print(f"  and {len(report.skipped) - LISTED} more")


def _depth_line(report: ImportReport) -> str:
    if not report.with_depth:
        return "no frame has a depth image"
    missing = report.frames - report.with_depth
    without = f"; {missing} of {counted(report.frames, 'frame')} without a depth image" if missing else ""
    median = f"; half of the first image is nearer than {report.median_depth_m:.2f} m" if report.median_depth_m else ""
    return f"{report.depth_scale}{median}{without}"
