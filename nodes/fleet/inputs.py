"""Which logs a fleet run takes: paths, URLs, globs, and manifests with tags."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.urls import full_url, is_url, open_url, reaching, shown

MANIFEST_SUFFIX = ".csv"
LOG_COLUMN = "log"
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


def find_inputs(arguments: Sequence[str], suffix: str) -> list[LogInput]:
    """Every log that is meant, once each, in the order of the arguments.

    A glob stands for the files that it matches (``site/*.mcap``) or, with a slash at its end, for folders
    (``site/*/``); a folder is the parts of one recording, as for ``replay``. A manifest is CSV with a column ``log``
    (relative paths count from the manifest) and any others, which become tags. Whether a log can be read is found out
    by its task.

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
    if argument.lower().endswith(MANIFEST_SUFFIX):
        yield from _read_manifest(argument)
        return
    _, path = open_url(argument)
    is_local = not is_url(argument)
    if is_local and os.path.exists(path):  # letters of globs may stand in names
        yield LogInput(path)
    elif _GLOB.search(path) and not argument.startswith(("http://", "https://")):
        yield from _matches(argument, suffix)
    elif is_local:
        raise ConfigError(f"{argument}: no such log; give a path, a URL, a glob or a manifest")
    else:
        yield LogInput(argument)


def _matches(argument: str, suffix: str) -> Iterator[LogInput]:
    fs, path = open_url(argument)
    wanted, kind = ("directory", "folder") if argument.endswith("/") else ("file", f"file that ends in {suffix}")
    with reaching(argument):
        matches = fs.glob(path, detail=True)
    names = sorted(name for name, info in matches.items() if info["type"] == wanted)
    if wanted == "file":
        names = [name for name in names if name.lower().endswith(suffix)]
    if not names:
        raise ConfigError(
            f"{shown(argument)}: matches no {kind}; put the pattern in quotes, try it with `ls`, and write [[] for a [ "
            "of a name"
        )
    for name in names:
        yield LogInput(full_url(fs, name, argument))


def _read_manifest(argument: str) -> Iterator[LogInput]:
    fs, path = open_url(argument)
    where = shown(argument)
    try:
        with reaching(argument):
            text = fs.cat_file(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{where}: is no text in UTF-8 ({error})") from error
    reader = csv.DictReader(text.splitlines(), strict=True)
    base = (argument if is_url(argument) else path).rsplit("/", 1)[0]
    try:
        if LOG_COLUMN not in (reader.fieldnames or ()):
            raise ConfigError(f"{where}: has no column '{LOG_COLUMN}'; name the column with paths or URLs so")
        for row in reader:
            if None in row or None in row.values():
                raise ConfigError(f"{where}: line {reader.line_num} has another number of columns than the first line")
            log = row.pop(LOG_COLUMN).strip()
            if not log:
                raise ConfigError(f"{where}: line {reader.line_num} names no log; fill its column '{LOG_COLUMN}'")
            url = log if is_url(log) or log.startswith("/") else f"{base}/{log}"
            yield LogInput(url, {name: value for name, value in row.items() if value})
    except csv.Error as error:
        raise ConfigError(f"{where}: line {reader.line_num}: {error}") from error
