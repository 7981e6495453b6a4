"""Files of a recording in parts, each a log by itself: ``kitchen.mcap``, ``kitchen-1.mcap``, ``kitchen-2.mcap``."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from semantic_mapper.errors import LogError
from semantic_mapper.replay.log.reader import LogReader

Log = LogReader
SUFFIX = ".mcap"
LISTED = 5  # files of a folder that an error names


def open_log(
    paths: Path | str | Sequence[Path],
    *,
    on_error: Callable[[LogError], None] = lambda error: None,
    allow_empty: bool = False,
) -> LogReader:
    """Open a log, or the parts of a recording as one: a file (that log alone), several (parts in any order), or a
    folder (all logs in it). See ``LogReader``, also for errors; LogError: a folder without logs.
    """
    named = [Path(paths)] if isinstance(paths, str | Path) else list(paths)
    files: list[Path] = []
    for path in named:
        files += sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    if not files:
        raise LogError(f"{named[0]}: cannot be read as a recording: the folder holds no log (*{SUFFIX})")
    try:
        return LogReader(files, on_error=on_error, allow_empty=allow_empty)
    except LogError as error:
        if len(named) > 1 or len(files) == 1:
            raise
        names = ", ".join(file.name for file in files[:LISTED]) + (", ..." if len(files) > LISTED else "")
        raise LogError(
            f"{named[0]}: a folder is taken for the parts of one recording, which its logs are not: {error}. To read "
            f"one of them, name its file: {names}"
        ) from error


def part_path(first: Path, part: int) -> Path:
    """Name of a part: that of the first one, with the number of any other."""
    return first if part == 0 else first.with_name(f"{first.stem}-{part}{first.suffix}")


def parts_on_disk(first: Path) -> dict[int, Path]:
    """Files that are named like the parts of a recording, by number."""
    found = {0: first} if first.exists() else {}
    name = re.compile(re.escape(first.stem) + r"-([1-9]\d*)" + re.escape(first.suffix))
    for file in first.parent.glob(f"*{first.suffix}"):
        if match := name.fullmatch(file.name):
            found[int(match[1])] = file
    return dict(sorted(found.items()))
