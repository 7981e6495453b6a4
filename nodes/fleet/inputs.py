"""Which logs a fleet run takes: paths, URLs, globs, and manifests with tags."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.urls import is_url, persistently, shown, split_url, unstripped

MANIFEST_SUFFIXES = (".csv", ".parquet")
LOG_COLUMN = "log"
MAX_MANIFEST_BYTES = 1 << 28
_GLOB = re.compile(r"[*?[]")


@dataclass(frozen=True, slots=True)
class LogInput:
    """One log, or one recording in parts, or one map.

    Args:
        url: Path or URL of a file, or of a folder with the parts of one recording.
        tags: What a manifest says of it, such as robot, site and date.
    """

    url: str
    tags: dict[str, str] = field(default_factory=dict[str, str])


def check_inputs(arguments: Sequence[str]) -> None:
    """Check that local files and folders are there, before the packages that read them are loaded.

    Raises:
        ConfigError: one is missing.
    """
    for argument in arguments:
        if not is_url(argument) and not _GLOB.search(argument) and not os.path.exists(argument):
            raise ConfigError(f"{argument}: no such log; give a path, a URL, a glob or a manifest")


def find_inputs(arguments: Sequence[str], suffix: str) -> list[LogInput]:
    """Every log that is meant, once each, in the order of their names within an argument.

    A glob stands for the files that it matches (``site/*.mcap``) or, with a slash at its end, for folders
    (``site/*/``); a folder is the parts of one recording, as for ``replay``. A manifest is CSV or Parquet with a column
    ``log`` (relative paths count from the manifest) and any others, which become tags. Whether a log that is named can
    be read is found out by its task.

    Args:
        arguments: Paths and URLs.
        suffix: Of files, such as ".mcap".

    Raises:
        ConfigError: a glob matches nothing, a path is missing, a manifest cannot be used, or there is no log at all.
        StoreError: something cannot be reached.
    """
    found: dict[str, LogInput] = {}
    for argument in arguments:
        for item in _expand(argument, suffix):
            earlier = found.get(item.url)
            if earlier is not None and earlier.tags and item.tags and earlier.tags != item.tags:
                raise ConfigError(f"{shown(item.url)}: is named twice, with other tags; keep one of the two")
            if earlier is None or item.tags:
                found[item.url] = item
    if not found:
        raise ConfigError("no logs are given; name some, as paths, URLs, globs or manifests")
    return list(found.values())


def _expand(argument: str, suffix: str) -> Iterator[LogInput]:
    if _without_query(argument).lower().endswith(MANIFEST_SUFFIXES):
        yield from _read_manifest(argument)
        return
    fs, path = split_url(argument)
    if not is_url(argument) and os.path.exists(path):  # letters of globs may stand in names
        yield LogInput(path)
        return
    if not _GLOB.search(path) or argument.startswith(("http://", "https://")):
        check_inputs([argument])
        yield LogInput(argument)
        return
    folders = argument.endswith("/")
    matches: dict[str, dict[str, Any]] = persistently(lambda: fs.glob(path, detail=True), shown(argument))
    wanted = "directory" if folders else "file"
    names = sorted(name for name, info in matches.items() if info.get("type") == wanted)
    if not folders:
        names = [name for name in names if name.lower().endswith(suffix)]
    if not names:
        kind = "folder" if folders else f"file that ends in {suffix}"
        raise ConfigError(
            f"{shown(argument)}: matches no {kind}; put the pattern in quotes, try it with `ls`, and write [[] for a [ "
            "of a name"
        )
    for name in names:
        yield LogInput(unstripped(fs, name, argument))


def _without_query(argument: str) -> str:
    return argument.split("?", 1)[0] if argument.startswith(("http://", "https://")) else argument


def _absolute(argument: str) -> str:
    if is_url(argument):
        return argument
    return split_url(argument)[1]


def _read_manifest(argument: str) -> Iterator[LogInput]:
    fs, path = split_url(argument)
    try:
        size = int(persistently(lambda: fs.info(path), shown(argument)).get("size") or 0)
        if size > MAX_MANIFEST_BYTES:
            raise ConfigError(f"{shown(argument)}: is larger than {MAX_MANIFEST_BYTES:,} bytes; split it")
        data: bytes = persistently(lambda: fs.cat_file(path), shown(argument))
    except FileNotFoundError as error:
        raise ConfigError(f"{shown(argument)}: no such manifest") from error
    rows = (
        _parquet_rows(data, argument)
        if _without_query(path).lower().endswith(".parquet")
        else _csv_rows(data, argument)
    )
    base = _without_query(argument).rsplit("/", 1)[0] if is_url(argument) else path.rsplit("/", 1)[0]
    count = 0
    for number, row in enumerate(rows, 1):
        log = (row.pop(LOG_COLUMN, "") or "").strip()
        if not log:
            raise ConfigError(f"{shown(argument)}: row {number} names no log; fill its column '{LOG_COLUMN}'")
        url = log if is_url(log) or log.startswith("/") else f"{base}/{log}"
        yield LogInput(_absolute(url), {name: value for name, value in row.items() if value})
        count += 1
    if not count:
        raise ConfigError(f"{shown(argument)}: has no rows; add one for each log")


def _csv_rows(data: bytes, where: str) -> Iterator[dict[str, str]]:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{shown(where)}: is no text in UTF-8 ({error})") from error
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        names = list(reader.fieldnames or ())
        if LOG_COLUMN not in names:
            raise ConfigError(
                f"{shown(where)}: has no column '{LOG_COLUMN}' (it has {', '.join(names) or 'none'}); name the column "
                "with paths or URLs so"
            )
        if len(set(names)) < len(names):
            raise ConfigError(f"{shown(where)}: two columns have the same name; rename one of them")
        for row in reader:
            if None in row or None in row.values():
                raise ConfigError(
                    f"{shown(where)}: line {reader.line_num} has another number of columns than its head; mend it"
                )
            yield dict(row)
    except csv.Error as error:
        raise ConfigError(f"{shown(where)}: line {reader.line_num}: {error}") from error


def _parquet_rows(data: bytes, where: str) -> Iterator[dict[str, str]]:
    import pyarrow
    from pyarrow import parquet

    try:
        table = parquet.read_table(pyarrow.BufferReader(data))
    except (pyarrow.ArrowException, OSError) as error:
        raise ConfigError(f"{shown(where)}: is no readable Parquet file ({error})") from error
    if LOG_COLUMN not in table.column_names:
        raise ConfigError(f"{shown(where)}: has no column '{LOG_COLUMN}' (it has {', '.join(table.column_names)})")
    for row in table.to_pylist():
        yield {name: "" if value is None else str(value) for name, value in row.items()}
