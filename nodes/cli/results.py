"""Folders that a replay has written, shown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semantic_mapper.nodes.cli.console import Output
from semantic_mapper.nodes.cli.summary_table import notes, result_lines, summary_table
from semantic_mapper.replay.summary import read_summary


def unique_names(folders: Sequence[Path]) -> list[str]:
    """Short names for folders, whole paths where the short ones are the same."""
    short = [f.resolve().name for f in folders]
    return [s if short.count(s) == 1 else str(f) for s, f in zip(short, folders, strict=True)]


def print_results(output: Output, folders: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Show the tables of result folders side by side, and where the files are.

    Raises:
        ConfigError: see ``read_summary``.
    """
    summaries = dict(zip(unique_names(folders), map(read_summary, folders), strict=True))
    if summaries:
        output.print(summary_table(summaries))
    for (name, summary), folder in zip(summaries.items(), folders, strict=True):
        for line in (*(f"{name}: {n}" for n in notes(summary)), *result_lines(folder)):
            output.print(line)
    return summaries
