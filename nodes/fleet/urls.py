"""Paths and URLs of logs and stores: what opens them, and how they are shown without what lets anybody in."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from semantic_mapper.backoff import backoff_s
from semantic_mapper.errors import ConfigError, DependencyError, FleetError, StoreError
from semantic_mapper.log_events import get_logger
from semantic_mapper.redaction import CHAIN, HIDDEN, NAMING_SCHEMES, user_length, without_secrets

TRIES = 8
FIRST_PAUSE_S, MAX_PAUSE_S = 0.5, 15.0

# Of addresses with a host and perhaps a port; a bucket is neither.
_HOST_SCHEMES = ("http", "https", "ftp", "sftp", "ssh", "smb", "hdfs", "webhdfs")
_SCHEME = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]*)://(.*)", re.DOTALL)
_log = get_logger(__name__)
_T = TypeVar("_T")


def is_url(text: str) -> bool:
    """Whether a URL is meant rather than a local path."""
    return bool(_split(text)[0])


def split_url(url: str) -> tuple[Any, str]:
    """The fsspec file system of a path or URL, and the path in it, without a slash at its end.

    Raises:
        ConfigError: an unknown scheme, or no host or port that can be.
        FleetError: a password in the URL.
        DependencyError: the extra ``fleet``, or the package for this scheme, is missing.
    """
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise DependencyError(f'a fleet needs more packages ({error}): pip install "semantic-mapper[fleet]"') from error
    refuse_credentials(url)
    _check_hosts(url)
    if not is_url(url) or url.startswith("file://"):
        url = str(Path(url.removeprefix("file://")).absolute())
    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise DependencyError(f"{shown(url)}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{shown(url)}: cannot be opened ({error})") from error
    return fs, str(path).rstrip("/")


def split_store_url(url: str) -> tuple[Any, str]:
    """As ``split_url``, of a folder that files are below.

    Raises:
        ConfigError: as there; or a query, which would be a part of every file's name.
    """
    if is_url(url) and shown(url).endswith("?" + HIDDEN):
        raise ConfigError(
            f"{shown(url)}: the URL of a folder cannot have a query or fragment; a signed URL is of one file only"
        )
    return split_url(url)


def shown(url: str) -> str:
    """A URL for logs, results and messages: without user information, query and fragment.

    Queries hold signatures (``X-Amz-Signature``, ``X-Goog-Signature``, ``sig``) and tokens; which of them do cannot be
    listed. Paths of files stay as they are.

    Args:
        url: Also one of fsspec's chained URLs (``simplecache::s3://...``).
    """
    return without_secrets(CHAIN.join(_shown_part(part) for part in url.split(CHAIN)))


def refuse_credentials(url: str) -> None:
    """Check that a URL holds no key, token or password: it would be in the shell's history and in the process table.

    Raises:
        FleetError: It does; names the ways that are there instead.
    """
    for part in url.split(CHAIN):
        scheme, rest = _split(part)
        user = rest[: user_length(scheme, rest)]
        if user and (":" in user or scheme.lower() not in NAMING_SCHEMES):
            raise FleetError(
                f"{shown(url)}: a URL must not hold a key, token or password; leave it out, and give it to every node "
                "in its environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, GOOGLE_APPLICATION_CREDENTIALS), in "
                "~/.aws, or in fsspec's configuration (~/.config/fsspec)"
            )


def _check_hosts(url: str) -> None:
    """Check host and port: packages raise whatever they like for them, or try again and again.

    Raises:
        ConfigError: one of the two is missing or impossible.
    """
    for part in url.split(CHAIN):
        if _split(part)[0].lower() not in _HOST_SCHEMES:
            continue
        try:
            address = urlsplit(part)
            host, _ = address.hostname or "", address.port
            host.encode("idna")
        except ValueError as error:
            raise ConfigError(f"{shown(url)}: is no address ({error}); write SCHEME://HOST:PORT/PATH") from error
        if not host or re.search(r"\s", host):
            raise ConfigError(f"{shown(url)}: names no host; write SCHEME://HOST:PORT/PATH")


def _shown_part(url: str) -> str:
    scheme, rest = _split(url)
    if not scheme:
        return url
    length = user_length(scheme, rest)
    user, place = rest[:length], rest[length:]
    is_name = scheme.lower() in NAMING_SCHEMES and ":" not in user
    path = re.split(r"[?#]", place, maxsplit=1)[0]
    return f"{scheme}://{user if is_name else ''}{path}{'' if path == place else '?' + HIDDEN}"


def _split(url: str) -> tuple[str, str]:
    """Scheme and all after ``://``; an empty scheme for paths."""
    match = _SCHEME.fullmatch(url)
    return (match[1], match[2]) if match else ("", url)


def persistently(call: Callable[[], _T], what: str, tries: int = TRIES) -> _T:
    """Do what needs a store; again after pauses where it cannot be reached or answers with an error of its own.

    Args:
        call: May be done twice without harm.
        what: Named in errors, without credentials.
        tries: At most.

    Raises:
        StoreError: it still cannot be done, or is refused.
        FileNotFoundError, FileExistsError: as they say.
    """
    for failures in range(1, tries + 1):
        try:
            return call()
        except FileExistsError:
            raise
        except (PermissionError, NotADirectoryError, IsADirectoryError) as error:
            reason = without_secrets(str(error))
            raise StoreError(f"{what}: is refused ({reason}); check the path, and who may read and write it") from error
        except _errors_of_stores() as error:
            if isinstance(error, FileNotFoundError) and _is_missing(error):
                raise
            reason = without_secrets(f"{type(error).__name__}: {error.__cause__ or error}")
            if failures == tries:
                raise StoreError(f"{what}: cannot be reached or written ({reason})") from error
            pause_s = backoff_s(failures, FIRST_PAUSE_S, MAX_PAUSE_S)
            _log.warning("store_retry", what=what, failures=failures, pause_s=pause_s, error=reason)
            time.sleep(pause_s)
    raise AssertionError("unreachable")


def _is_missing(error: FileNotFoundError) -> bool:
    """Whether something is not there; fsspec raises the same error for whatever a web server answers."""
    cause = error.__cause__
    if cause is None or not type(cause).__module__.startswith("aiohttp"):
        return True
    return getattr(cause, "status", None) in (404, 410)  # of aiohttp's many errors only answers have one


def _errors_of_stores() -> tuple[type[BaseException], ...]:
    """What the packages in use raise for failed requests; not all of it is an ``OSError``."""
    names = (
        ("botocore.exceptions", "BotoCoreError"),
        ("botocore.exceptions", "ClientError"),
        ("aiohttp", "ClientError"),
        ("gcsfs.retry", "HttpError"),
        ("google.auth.exceptions", "GoogleAuthError"),
        ("fsspec.exceptions", "FSTimeoutError"),
    )
    loaded = [getattr(sys.modules[module], name) for module, name in names if module in sys.modules]
    return (OSError, *loaded)


def unstripped(fs: Any, path: str, like: str) -> str:
    """URL of a path in a file system; ``like`` is a URL or path of the same one."""
    return str(fs.unstrip_protocol(path)) if is_url(like) and not like.startswith("file:") else path
