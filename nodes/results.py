"""Folders that a replay has written: reading and showing them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nodes.console import Output
from nodes.summary_table import notes, result_lines, summary_table
from semantic_mapper.errors import ConfigError


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary in a result folder.

    Raises:
        ConfigError: there is none, or it is damaged.
    """
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(
            f"{folder}: no summary.json; give a folder that `semantic-mapper replay` has written"
        ) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    if not isinstance(summary, dict) or "frames" not in summary or "metrics" not in summary:
        raise ConfigError(f"{path}: is not the summary of a replay")
    return summary


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
