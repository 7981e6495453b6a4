"""Paths and URLs of logs and stores: what opens them, and how they are shown without credentials."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from semantic_mapper.backoff import backoff_s
from semantic_mapper.errors import ConfigError, DependencyError, StoreError
from semantic_mapper.log_events import get_logger

TRIES = 6
FIRST_PAUSE_S, MAX_PAUSE_S = 0.5, 15.0

_log = get_logger(__name__)
_T = TypeVar("_T")

_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*(?=://|::)")
_SECRET = re.compile(r"signature|token|secret|password|credential|security|key|sig|auth", re.IGNORECASE)


def is_url(text: str) -> bool:
    """Whether a URL is meant rather than a local path."""
    return _SCHEME.match(text) is not None


def split_url(url: str) -> tuple[Any, str]:
    """The fsspec file system of a path or URL, and the path in it, without a slash at its end.

    Raises:
        ConfigError: an unknown scheme, or credentials in the URL.
        DependencyError: the package for this scheme is missing.
    """
    from fsspec.core import url_to_fs

    if is_url(url) and not url.startswith("file:"):
        parts = urlsplit(url)
        if parts.password or (parts.username and parts.scheme not in ("http", "https")):
            raise ConfigError(
                f"{shown(url)}: has credentials in it, which would end in logs; give them as the protocol's own "
                "environment variables or files (s3: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or ~/.aws)"
            )
    else:
        url = str(Path(url.removeprefix("file://")).absolute())
    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise DependencyError(f"{shown(url)}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{shown(url)}: cannot be opened ({error})") from error
    return fs, str(path).rstrip("/")


def shown(url: str) -> str:
    """A URL for logs and results: without user, password, and what looks like a signature or token in its query."""
    if not is_url(url):
        return url
    parts = urlsplit(url)
    host = parts.netloc.rsplit("@", 1)[-1]
    query = [(k, "***" if _SECRET.search(k) else v) for k, v in parse_qsl(parts.query, keep_blank_values=True)]
    return urlunsplit((parts.scheme, host, parts.path, urlencode(query, safe="*"), ""))


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
        except (FileNotFoundError, FileExistsError):
            raise
        except (PermissionError, NotADirectoryError, IsADirectoryError) as error:
            raise StoreError(f"{what}: is refused ({error}); check the credentials and the path") from error
        except _errors_of_stores() as error:
            if failures == tries:
                raise StoreError(f"{what}: cannot be reached or written ({type(error).__name__}: {error})") from error
            pause_s = backoff_s(failures, FIRST_PAUSE_S, MAX_PAUSE_S)
            _log.warning("store_retry", what=what, failures=failures, pause_s=pause_s, error=str(error))
            time.sleep(pause_s)
    raise AssertionError("unreachable")


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
