"""URLs of logs and stores, as they may be shown and kept: without what lets anybody in."""

from __future__ import annotations

import re

from semantic_mapper.errors import FleetError

_SCHEME = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]*)://(.*)", re.DOTALL)
_CHAIN = "::"  # between the parts of fsspec's chained URLs
_PORT = re.compile(r"[^:]*:\d+")
_HIDDEN = "..."
# Where what stands before the @ is a container or the name of an account, and says where something is.
_NAMING_SCHEMES = ("abfs", "abfss", "az", "ftp", "hdfs", "scp", "sftp", "smb", "ssh", "wasb", "wasbs")


def shown(url: str) -> str:
    """A URL for logs, results and messages: without user information, query and fragment.

    Queries hold signatures (``X-Amz-Signature``, ``X-Goog-Signature``, ``sig``) and tokens; which of them do cannot be
    listed. Paths of files stay as they are.

    Args:
        url: Also one of fsspec's chained URLs (``simplecache::s3://...``).
    """
    return _CHAIN.join(_shown_part(part) for part in url.split(_CHAIN))


def refuse_credentials(url: str) -> None:
    """Check that a URL holds no password: it would be in the shell's history and in the process table.

    Raises:
        FleetError: It does; names the ways that are there instead.
    """
    for part in url.split(_CHAIN):
        scheme, rest = _split(part)
        if ":" in rest[: _user_length(scheme, rest)]:
            raise FleetError(
                f"{shown(url)}: a URL must not hold a key or password; leave it out, and give it to every node in its "
                "environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, GOOGLE_APPLICATION_CREDENTIALS), in ~/.aws, or "
                "in fsspec's configuration (~/.config/fsspec)"
            )


def _shown_part(url: str) -> str:
    scheme, rest = _split(url)
    if not scheme:
        return url
    length = _user_length(scheme, rest)
    user, place = rest[:length], rest[length:]
    is_name = scheme.lower() in _NAMING_SCHEMES and ":" not in user
    path = re.split(r"[?#]", place, maxsplit=1)[0]
    return f"{scheme}://{user if is_name else ''}{path}{'' if path == place else '?' + _HIDDEN}"


def _split(url: str) -> tuple[str, str]:
    """Scheme and all after ``://``; an empty scheme for paths."""
    match = _SCHEME.fullmatch(url)
    return (match[1], match[2]) if match else ("", url)


def _user_length(scheme: str, rest: str) -> int:
    """Letters up to and including the @ of user information; 0 = there is nothing of the kind.

    Secret keys of AWS contain slashes, so that user information may seem to end before it does.
    """
    if not scheme or scheme == "file":
        return 0
    host = re.split(r"[/?#]", rest, maxsplit=1)[0]
    if "@" in host:
        return host.rindex("@") + 1
    if ":" in host and "@" in rest and not _PORT.fullmatch(host):
        return rest.rindex("@") + 1
    return 0
