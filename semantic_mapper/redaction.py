"""URLs and texts with URLs, as they may be shown: without what lets anybody in.

``without_secrets`` is applied wherever text leaves the program for people or files: errors, log events, tables, JSON,
reports. It knows malformed addresses, too: ``Path`` takes a slash of ``s3://KEY:SECRET@bucket`` away, and people forget
one. What it cannot judge it hides: a user name, rather than a place, when uncertain.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import count
from typing import Any

HIDDEN = "..."
CHAIN = "::"  # between the parts of fsspec's chained URLs
# Where what stands before the @ is a container or the name of an account, and says where something is.
NAMING_SCHEMES = ("abfs", "abfss", "az", "hdfs", "scp", "sftp", "smb", "ssh", "wasb", "wasbs")
_BUCKETS = ("s3", "s3a", "s3n", "gs", "gcs", "oss", "r2")  # a colon in the place of the host is never that of a port
_CAMERAS = ("rtsp", "rtsps", "rtmp")  # their queries say which camera is meant

# Encoded once or more often.
_COLON, _SLASH, _AT = r"(?::|%(?:25)*3[aA])", r"(?:[/\\]|%(?:25)*2[fF]|%(?:25)*5[cC])", r"(?:@|%(?:25)*40)"
# A scheme, then slashes, however many (without colon or slashes only well-known ones, before NAME:SECRET@).
_KNOWN = "|".join((*_BUCKETS, *_CAMERAS, *NAMING_SCHEMES, "https?", "ftp", "memory"))
_NEXT = rf"{CHAIN}[a-zA-Z][\w+.-]*:"  # the next part of a chain
_PAIR = r"[^\s/:@]{1,128}:(?!//)[^\s@]{1,256}@"  # bounded: texts may be long
# User information may hold nearly every letter: it ends at the last @ before a blank, or after one at the first.
_PORT_THEN = r"(?:\d+|PORT|\*|\{\w+\})(?!\w)"
_BLANKS = rf"[^\s/:@\[]{{1,128}}:(?!{_PORT_THEN})[^\s@](?:(?!://)[^@\n]){{0,256}}@"
_USER = rf"(?:{_BLANKS})?(?:(?:(?!://|{_NEXT})\S)*{_AT})?"
_URL = re.compile(
    rf"(?:(?<![\w+.])(?P<scheme>[a-zA-Z][a-zA-Z0-9+.-]{{0,31}})(?P<mark>{_COLON}(?!:){_SLASH}+(?: +(?={_PAIR}))?)"
    rf"|(?<![\w+.])(?P<known>{_KNOWN})(?P<short>:)(?={_PAIR})"
    rf"|(?<![\w+./])(?P<first>{_KNOWN})(?P<slashes>{_SLASH}+)(?={_PAIR}))"
    rf"(?P<rest>{_USER}(?:(?!{_NEXT})[^\s'\"<>()?])*(?:\?(?:(?!{_NEXT})[^\s\"<>])*)?)",
    re.IGNORECASE,
)
# NAME:SECRET@ alone, at the beginning of a word.
_NO_SCHEME = re.compile(rf"(?<![\w/%.@-])(?<![\w+.-]:)/{{0,2}}[\w.+%-]{{1,128}}:(?![/\\])[^\s:@]{{4,}}{_AT}(?=\w)")
_SECRET_NAME = (
    r"(?:token|secret|passw|passphrase|pwd|(?<![a-z])pw\b|pass\b|key\b|keyid|credential|sig\b|signature|auth|sas\b)"
)
_WORD_NAME = r"(?:token|secret|password|passwd|passphrase|pwd|(?<![a-z])pw)"  # tells a secret wherever it stands
_VALUE = r"(?:\"[^\"]*\"|'[^']*'|(?:[^&;#\s'\"<>]|'(?=\w))+)"
_EQUALS = r"(?:=|%(?:25)*3d)"
_PARAMETER = re.compile(
    rf"(?P<name>(?:(?:[?&;#!]|%(?:25)*(?:3f|26|3b))(?:p|[\w.-]{{0,64}}{_SECRET_NAME}[\w.-]*)"
    rf"|(?<=\s)[\w.-]{{0,64}}{_WORD_NAME}){_EQUALS}){_VALUE}",
    re.IGNORECASE,
)
_CAMERA_PARAMETER = re.compile(
    rf"(?P<name>(?:(?<![a-z0-9])p|{_SECRET_NAME}[\w.-]{{0,64}}){_EQUALS}){_VALUE}", re.IGNORECASE
)
_FIRST_PARAMETER = re.compile(rf"\A(?P<name>[\w.-]{{0,64}}{_WORD_NAME}=){_VALUE}", re.IGNORECASE)
_HOST_END = re.compile(r"[/?#\\]|%(?:25)*2[fF]|%(?:25)*3[fF]|;(?=\w+=)")
_QUERY = re.compile(r"[?#]|%(?:25)*3[fF]|;(?=[\w.-]+=)")
_PORT = re.compile(r"(?:\[[0-9a-fA-F:.%]*\]|[^:]*):(?:\d*|[A-Z]+|\*|\{\w+\})")
_TRAILING = ".,;:!]}`|'\")>"


def without_secrets(text: str) -> str:
    """A text whose addresses have neither user information nor, but for cameras, parameters.

    Args:
        text: Of any kind: a message, a cell of a table. Absolute paths and text without addresses stay as they are.
    """
    return _FIRST_PARAMETER.sub(rf"\g<name>{HIDDEN}", _NO_SCHEME.sub(HIDDEN, _without_secrets_of_urls(text)))


def plain_without_secrets(value: Any) -> Any:
    """Plain data, as it becomes JSON, without the secrets of URLs in its texts, names of fields included.

    What has no scheme stays: here it is a name or a path. No two fields become one.
    """
    if isinstance(value, str):
        return _without_secrets_of_urls(value)
    if isinstance(value, Mapping):
        found: dict[Any, Any] = {}
        for name, item in value.items():
            found[_other_name(plain_without_secrets(name), found)] = plain_without_secrets(item)
        return found
    if isinstance(value, list | tuple):
        return [plain_without_secrets(item) for item in value]
    return value


def _other_name(name: Any, taken: Mapping[Any, Any]) -> Any:
    """The name, or the first of "NAME (2)", "NAME (3)", ... that is free."""
    return name if name not in taken else next(n for i in count(2) if (n := f"{name} ({i})") not in taken)


def _without_secrets_of_urls(text: str) -> str:
    if not any(mark in text for mark in "@=:%"):
        return text
    return _PARAMETER.sub(rf"\g<name>{HIDDEN}", _URL.sub(_shown_match, text))


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
    scheme, rest = match["scheme"] or match["known"] or match["first"], match["rest"]
    if scheme.lower() == "file":
        return match[0]
    begin = scheme + (match["mark"] or match["short"] or match["slashes"])
    after = rest[len(rest.rstrip(_TRAILING)) :]
    rest = rest[: len(rest) - len(after)]
    length = user_length(scheme, rest)
    user, place = rest[:length], rest[length:]
    is_name = scheme.lower() in NAMING_SCHEMES and not re.search(_COLON, user)
    host = _HOST_END.split(place, maxsplit=1)[0]
    if scheme.lower() in _BUCKETS and re.search(_COLON, host) and not length:  # a key whose @ is missing
        return f"{begin}{HIDDEN}{after}"
    if scheme.lower() in _CAMERAS:
        return begin + _CAMERA_PARAMETER.sub(rf"\g<name>{HIDDEN}", place) + after
    path = _QUERY.split(place, maxsplit=1)[0]
    query = f"?{HIDDEN}" if len(place) > len(path) + 1 else place[len(path) :]  # ? alone: it is hidden already
    return f"{begin}{user if is_name else ''}{path}{query}{after}"
