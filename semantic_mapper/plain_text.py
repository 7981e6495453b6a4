"""Text from people, files and sockets, made safe to show: without secrets of addresses and what steers a terminal.

``without_secrets`` is applied wherever text leaves the program for people or files: errors, log events, tables, JSON,
reports. What it cannot judge it hides.
"""

import re
from collections.abc import Mapping
from typing import Any

HIDDEN = "..."
# Where what stands before the @ is a container or the name of an account, and says where something is.
NAMING_SCHEMES = ("abfs", "abfss", "az", "hdfs", "scp", "sftp", "smb", "ssh", "wasb", "wasbs")

# NAME:SECRET@ or TOKEN@; what follows a colon is a port where it is a number. Lengths are bounded: texts may be long.
_USER = r"(?:[^\s/:]{0,128}:(?!\d{1,5}(?:[/?#]|$))[^\s'\"]{0,256}@|[^\s/:@?#]{1,128}@)"
# ``Path`` takes a slash of ``s3://`` away.
_URL = re.compile(rf"(?<![\w+.])(?P<scheme>[a-zA-Z][\w+.-]{{0,31}}):(?P<slashes>/+)(?P<user>{_USER})")
_NO_SCHEME = re.compile(r"(?<![^\s'\"(\[])/{0,2}[\w.+%-]{1,128}:(?![\\/])[^\s'\"@]{4,256}@(?=\w)")
_PARAMETER = re.compile(
    r"(?P<name>(?:(?<=[?&;#])[\w.-]{0,64}(?:token|secret|pass|pwd|pw|key|credential|sig|auth|sas)"
    r"|(?<![^\s'\"])[\w.-]{0,64}(?:token|secret|passw|pw))[\w.-]{0,64}=)(?:\"[^\"]*\"|[^&;#\s'\"<>]+)",
    re.IGNORECASE,
)


def without_secrets(text: str) -> str:
    """A text whose addresses have neither user information nor values of parameters that are called as secrets are."""
    return _NO_SCHEME.sub(HIDDEN, _without_secrets_of_urls(text))


def plain_without_secrets(value: Any) -> Any:
    """Plain data, as it becomes JSON, without the secrets of URLs in its texts and names of fields.

    What has no scheme stays: here it is a name or a path.
    """
    if isinstance(value, str):
        return _without_secrets_of_urls(value)
    if isinstance(value, Mapping):
        return {plain_without_secrets(name): plain_without_secrets(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_without_secrets(item) for item in value]
    return value


def _without_secrets_of_urls(text: str) -> str:
    if not any(mark in text for mark in "@="):
        return text
    return _PARAMETER.sub(rf"\g<name>{HIDDEN}", _URL.sub(_without_user, text))


def _without_user(match: re.Match[str]) -> str:
    is_name = match["scheme"].lower() in NAMING_SCHEMES and ":" not in match["user"]
    return match[0] if is_name else f"{match['scheme']}:{match['slashes']}"


def counted(count: int, one: str, many: str = "") -> str:
    """A number of things: 1 frame, 2 frames; ``many`` where it is not ``one`` with an s."""
    return f"{count} {one}" if count == 1 else f"{count} {many or one + 's'}"


def visible(text: str, keep: str = "") -> str:
    r"""The text with every character that prints nothing, or steers what shows it, as an escape such as ``\x1b``.

    These are control characters (terminal commands, line breaks, tabs), those that turn the direction of writing, and
    halves of surrogate pairs, as file names that are not UTF-8 hold them. Characters of ``keep`` stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in text)
