"""Reading the summary of a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import read_regular

SUMMARY_FILE = "summary.json"
MAX_SUMMARY_BYTES = 1 << 24


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary in a result folder.

    Raises:
        ConfigError: there is none, or it is damaged.
    """
    path = folder / SUMMARY_FILE
    try:
        summary = json.loads(read_regular(path, MAX_SUMMARY_BYTES))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ConfigError(
            f"{folder}: no summary.json; give a folder that `semantic-mapper replay` has written"
        ) from error
    except RecursionError as error:
        raise ConfigError(f"{path}: cannot be read: too many values inside each other") from error
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    if not isinstance(summary, dict) or "frames" not in summary or "metrics" not in summary:
        raise ConfigError(f"{path}: is not the summary of a replay")
    return summary


def dig(summary: Mapping[str, Any], path: str) -> Any:
    """The value at a dotted place of a summary, None where it has no such place."""
    value: Any = summary
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
