"""Paths and URLs of a fleet: what opens them, how they are shown, and which logs a run takes."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semantic_mapper.errors import ConfigError, DependencyError, FleetError, SemanticMapperError, StoreError
from semantic_mapper.plain_text import without_secrets

_SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://")
_GLOB = re.compile(r"[*?[]")
_LOG_COLUMN = "log"


class MissingError(StoreError):
    """There is no such file or object."""


def is_url(text: str) -> bool:
    """Whether a URL is meant rather than a local path."""
    return _SCHEME.match(text) is not None


def open_url(url: str) -> tuple[Any, str]:
    """The fsspec file system of a path or URL, and the path in it, without a slash at its end.

    Raises:
        ConfigError: no such scheme, or no address.
        FleetError: a key, token or password in the URL.
        DependencyError: the extra ``fleet``, or the package for this scheme, is missing.
    """
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise DependencyError(f'a fleet needs more packages ({error}): pip install "semantic-mapper[fleet]"') from error
    place = re.split(r"[?#]", url, maxsplit=1)[0]
    if is_url(url) and without_secrets(place) != place:  # it would be in the shell's history and in the process table
        raise FleetError(
            f"{without_secrets(url)}: a URL must not hold a key, token or password; leave it out, and give it to every "
            "node in its environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, GOOGLE_APPLICATION_CREDENTIALS), in "
            "~/.aws, or in fsspec's configuration (~/.config/fsspec)"
        )
    if not is_url(url) or url.startswith("file://"):
        url = str(Path(url.removeprefix("file://")).absolute())
    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise DependencyError(f"{without_secrets(url)}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{without_secrets(url)}: cannot be opened ({error})") from error
    return fs, str(path).rstrip("/")


def full_url(fs: Any, path: str, like: str) -> str:
    """URL of a path in a file system; ``like`` is a URL or path of the same one."""
    return str(fs.unstrip_protocol(path)) if is_url(like) and not like.startswith("file:") else path


@contextmanager
def reaching(url: str) -> Iterator[None]:
    """Errors of requests as one of ours; the packages repeat a request by themselves where that may help.

    Raises:
        MissingError: there is no such thing.
        StoreError: it cannot be reached, or is refused.
    """
    shown = without_secrets(url)
    try:
        yield
    except SemanticMapperError:
        raise
    except FileNotFoundError as error:
        raise MissingError(f"{shown}: is missing") from error
    except (PermissionError, NotADirectoryError, IsADirectoryError) as error:
        raise StoreError(
            f"{shown}: is refused ({without_secrets(str(error))}); check the path, and who may read and write it"
        ) from error
    except Exception as error:  # packages of buckets raise errors of their own, which share no base
        reason = without_secrets(f"{type(error).__name__}: {error.__cause__ or error}")
        raise StoreError(f"{shown}: cannot be reached or written ({reason})") from error


@dataclass(frozen=True, slots=True)
class LogInput:
    """One log, or one recording in parts, or one map."""

    url: str  # path or URL of a file, or of a folder with the parts of one recording
    # what a manifest says of it, such as robot, site and date
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
            if item.tags or item.url not in found:
                found[item.url] = item
    if not found:
        raise ConfigError("no logs are given; name some, as paths, URLs, globs or manifests")
    return list(found.values())


def _expand(argument: str, suffix: str) -> Iterator[LogInput]:
    if argument.lower().endswith(".csv"):
        yield from _read_manifest(argument)
        return
    fs, path = open_url(argument)
    is_local = not is_url(argument)
    if is_local and os.path.exists(path):  # letters of globs may stand in names
        yield LogInput(path)
    elif _GLOB.search(path) and not argument.startswith(("http://", "https://")):
        wanted, kind = ("directory", "folder") if argument.endswith("/") else ("file", f"file that ends in {suffix}")
        with reaching(argument):
            matches = fs.glob(path, detail=True)
        names = sorted(name for name, info in matches.items() if info["type"] == wanted)
        names = [name for name in names if wanted == "directory" or name.lower().endswith(suffix)]
        if not names:
            raise ConfigError(f"{argument}: matches no {kind}; put the pattern in quotes, and try it with `ls`")
        yield from (LogInput(full_url(fs, name, argument)) for name in names)
    elif is_local:
        raise ConfigError(f"{argument}: no such log; give a path, a URL, a glob or a manifest")
    else:
        yield LogInput(argument)


def _read_manifest(argument: str) -> Iterator[LogInput]:
    fs, path = open_url(argument)
    base = (argument if is_url(argument) else path).rsplit("/", 1)[0]
    try:
        with reaching(argument):
            data = fs.cat_file(path)
        reader = csv.DictReader(data.decode("utf-8-sig").splitlines(), strict=True)
        if _LOG_COLUMN not in (reader.fieldnames or ()):
            raise ConfigError(f"{argument}: has no column '{_LOG_COLUMN}'; name the column with paths or URLs so")
        for row in reader:
            where = f"{argument}: line {reader.line_num}"
            if None in row or None in row.values():
                raise ConfigError(f"{where} has another number of columns than the first line")
            log = row.pop(_LOG_COLUMN).strip()
            if not log:
                raise ConfigError(f"{where} names no log; fill its column '{_LOG_COLUMN}'")
            url = log if is_url(log) or log.startswith("/") else f"{base}/{log}"
            yield LogInput(url, {name: value for name, value in row.items() if value})
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{without_secrets(argument)}: is no CSV in UTF-8 ({error})") from error
