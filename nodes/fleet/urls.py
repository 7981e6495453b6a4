"""Paths and URLs of logs and stores: what opens them, and how they are shown without what lets anybody in."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from semantic_mapper.errors import ConfigError, DependencyError, FleetError, StoreError
from semantic_mapper.plain_text import CHAIN, HIDDEN, NAMING_SCHEMES, user_length, without_secrets

_SCHEME = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]*)://(.*)", re.DOTALL)
# What packages raise for failed requests, besides ``OSError``.
_OTHER_ERRORS = (
    ("botocore.exceptions", "BotoCoreError"),
    ("botocore.exceptions", "ClientError"),
    ("aiohttp", "ClientError"),
    ("gcsfs.retry", "HttpError"),
    ("google.auth.exceptions", "GoogleAuthError"),
    ("fsspec.exceptions", "FSTimeoutError"),
)


class MissingError(StoreError):
    """There is no such file or object."""


def is_url(text: str) -> bool:
    """Whether a URL is meant rather than a local path."""
    return bool(_split(text)[0])


def open_url(url: str) -> tuple[Any, str]:
    """The fsspec file system of a path or URL, and the path in it, without a slash at its end.

    Raises:
        ConfigError: no such scheme, or no address.
        FleetError: a password in the URL.
        DependencyError: the extra ``fleet``, or the package for this scheme, is missing.
    """
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise DependencyError(f'a fleet needs more packages ({error}): pip install "semantic-mapper[fleet]"') from error
    _refuse_credentials(url)
    if not is_url(url) or url.startswith("file://"):
        url = str(Path(url.removeprefix("file://")).absolute())
    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise DependencyError(f"{shown(url)}: {error}") from error
    except ValueError as error:
        raise ConfigError(f"{shown(url)}: cannot be opened ({error})") from error
    return fs, str(path).rstrip("/")


def shown(url: str) -> str:
    """A URL for logs, results and messages: without user information, query and fragment. Paths stay as they are."""
    return CHAIN.join(_shown_part(part) for part in url.split(CHAIN))


def full_url(fs: Any, path: str, like: str) -> str:
    """URL of a path in a file system; ``like`` is a URL or path of the same one."""
    return str(fs.unstrip_protocol(path)) if is_url(like) and not like.startswith("file:") else path


@contextmanager
def reaching(url: str) -> Iterator[None]:
    """Errors of requests as one of ours; the packages repeat a request by themselves where that may help.

    Raises:
        MissingError: there is no such thing.
        StoreError: it cannot be reached, or is refused.
        FileExistsError: as it says.
    """
    others = [getattr(sys.modules[module], name) for module, name in _OTHER_ERRORS if module in sys.modules]
    try:
        yield
    except (StoreError, FileExistsError):
        raise
    except FileNotFoundError as error:
        raise MissingError(f"{shown(url)}: is missing") from error
    except (PermissionError, NotADirectoryError, IsADirectoryError) as error:
        raise StoreError(
            f"{shown(url)}: is refused ({without_secrets(str(error))}); check the path, and who may read and write it"
        ) from error
    except (OSError, *others) as error:
        reason = without_secrets(f"{type(error).__name__}: {error.__cause__ or error}")
        raise StoreError(f"{shown(url)}: cannot be reached or written ({reason})") from error


def _refuse_credentials(url: str) -> None:
    """A URL with a key, token or password would be in the shell's history and in the process table."""
    for part in url.split(CHAIN):
        scheme, rest = _split(part)
        user = rest[: user_length(scheme, rest)]
        if user and (":" in user or scheme.lower() not in NAMING_SCHEMES):
            raise FleetError(
                f"{shown(url)}: a URL must not hold a key, token or password; leave it out, and give it to every node "
                "in its environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, GOOGLE_APPLICATION_CREDENTIALS), in "
                "~/.aws, or in fsspec's configuration (~/.config/fsspec)"
            )


def _shown_part(url: str) -> str:
    """Whatever the query is called: it may hold a signature."""
    scheme, rest = _split(url)
    if not scheme:
        return without_secrets(url)
    length = user_length(scheme, rest)
    user, place = rest[:length], rest[length:]
    is_name = scheme.lower() in NAMING_SCHEMES and ":" not in user
    path = re.split(r"[?#]", place, maxsplit=1)[0]
    return f"{scheme}://{user if is_name else ''}{path}{'' if path == place else '?' + HIDDEN}"


def _split(url: str) -> tuple[str, str]:
    """Scheme and all after ``://``; an empty scheme for paths."""
    match = _SCHEME.fullmatch(url)
    return (match[1], match[2]) if match else ("", url)
