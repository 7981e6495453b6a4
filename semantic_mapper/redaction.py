"""URLs and texts with URLs, as they may be shown: without what lets anybody in.

``without_secrets`` is applied wherever text leaves the program for people or files: errors, log events, tables, JSON,
reports. It knows malformed addresses, too: ``Path`` takes a slash of ``s3://KEY:SECRET@bucket`` away, and people forget
one. What it cannot judge it hides: a user name, rather than a place, in doubt.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

HIDDEN = "..."
CHAIN = "::"  # between the parts of fsspec's chained URLs
# Where what stands before the @ is a container or the name of an account, and says where something is.
NAMING_SCHEMES = ("abfs", "abfss", "az", "ftp", "hdfs", "scp", "sftp", "smb", "ssh", "wasb", "wasbs")
_BUCKETS = ("s3", "s3a", "s3n", "gs", "gcs", "oss", "r2")  # a colon in the place of the host is never that of a port
_CAMERAS = ("rtsp", "rtsps", "rtmp")  # their queries say which camera is meant

_COLON, _SLASH, _AT = r"(?::|%3[aA])", r"(?:[/\\]|%2[fF]|%5[cC])", r"(?:@|%40)"
_SCHEME = r"(?<![\w+.])(?P<scheme>[a-zA-Z][a-zA-Z0-9+.-]{0,31})"
# A scheme, then slashes, however many (none only before NAME:SECRET@), up to the next part of a chain.
_NEXT = rf"{CHAIN}[a-zA-Z][\w+.-]*:"
_PAIR = r"[^\s/:@]{1,128}:[^\s@]{1,256}@"  # bounded: texts may be long
_URL = re.compile(
    rf"{_SCHEME}(?P<mark>{_COLON}(?!:){_SLASH}+|{_SLASH}{{2}}(?={_PAIR})|:(?={_PAIR}))"
    rf"(?P<rest>(?:(?!{_NEXT})[^\s'\"<>()])*)"
)
# NAME:SECRET@ alone; behind a slash, as in a path, only a long one.
_USER, _KEY = r"[\w.+%-]{1,128}:(?![/\\])", r"[^\s:@'\"<>()]"
_NO_SCHEME = re.compile(
    rf"(?:(?<![\w/%.@-])(?<![\w+.-]:)/{{0,2}}{_USER}{_KEY}{{4,}}|(?<=/){_USER}{_KEY}{{8,}}){_AT}(?=\w)"
)
_SECRET_NAME = r"(?:token|secret|passw|pwd|pass\b|key\b|keyid|credential|sig\b|signature|auth|sas\b)"
_PARAMETER = re.compile(
    rf"(?P<name>(?:[?&;#]|%3f|%26|%3b)[\w.-]*{_SECRET_NAME}[\w.-]*(?:=|%3d))[^&;#\s'\"<>]+", re.IGNORECASE
)
_HOST_END = re.compile(r"[/?#\\]|%2[fF]|%3[fF]|;(?=\w+=)")
_QUERY = re.compile(r"[?#]|%3[fF]|;(?=[\w.-]+=)")
_PORT = re.compile(r"(?:\[[0-9a-fA-F:.%]*\]|[^:]*):(?:\d*|[A-Z]+|\*|\{\w+\})")
_TRAILING = re.compile(r"[.,;:!\]}`|]*\Z")


def without_secrets(text: str) -> str:
    """A text whose addresses have neither user information nor, but for cameras, parameters.

    Args:
        text: Of any kind: a message, a path, a cell of a table. Paths and text without addresses stay as they are.
    """
    if "@" not in text and "=" not in text and "%40" not in text and ":" not in text:
        return text
    text = _URL.sub(_shown_match, text)
    text = _NO_SCHEME.sub(HIDDEN, text)
    return _PARAMETER.sub(rf"\g<name>{HIDDEN}", text)


def plain_without_secrets(value: Any) -> Any:
    """Plain data, as it becomes JSON, with ``without_secrets`` applied to all texts in it, names of fields included."""
    if isinstance(value, str):
        return without_secrets(value)
    if isinstance(value, Mapping):
        return {plain_without_secrets(name): plain_without_secrets(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_without_secrets(item) for item in value]
    return value


def user_length(scheme: str, rest: str) -> int:
    """Letters up to and including the @ of user information; 0 = there is nothing of the kind.

    Secret keys of AWS contain slashes, so that user information may seem to end before it does.

    Args:
        scheme: Before ``://``; empty for paths.
        rest: All after it.
    """
    if not scheme or scheme == "file":
        return 0
    host = _HOST_END.split(rest, maxsplit=1)[0]
    length = max((found.end() for found in re.finditer(_AT, host)), default=0)
    host = host[length:]  # of the place, or of a secret with slashes, which has another @ behind it
    has_port = scheme.lower() not in _BUCKETS and _PORT.fullmatch(host)
    if re.search(_COLON, host) and not has_port:
        length = max((found.end() for found in re.finditer(_AT, rest)), default=length)
    return length


def _shown_match(match: re.Match[str]) -> str:
    scheme, rest = match["scheme"], match["rest"]
    if scheme.lower() == "file":
        return match[0]
    tail = _TRAILING.search(rest)
    assert tail is not None
    rest, after = rest[: tail.start()], tail[0]
    length = user_length(scheme, rest)
    user, place = rest[:length], rest[length:]
    is_name = scheme.lower() in NAMING_SCHEMES and not re.search(_COLON, user)
    host = _HOST_END.split(place, maxsplit=1)[0]
    if scheme.lower() in _BUCKETS and re.search(_COLON, host) and not length:  # a key whose @ is missing
        return f"{scheme}{match['mark']}{HIDDEN}{after}"
    if scheme.lower() in _CAMERAS:
        return f"{scheme}{match['mark']}{place}{after}"
    path = _QUERY.split(place, maxsplit=1)[0]
    query = f"?{HIDDEN}" if len(place) > len(path) + 1 else place[len(path) :]  # ? alone: it is hidden already
    return f"{scheme}{match['mark']}{user if is_name else ''}{path}{query}{after}"
