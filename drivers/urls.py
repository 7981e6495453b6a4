"""Addresses of streams, as people may see them."""

from __future__ import annotations

import re

_USER = re.compile(r"(?<=://)([^/?#:]*):[^/?#]*@")
_QUERY = re.compile(r"([?&](?:password|passwd|pwd|pass|token|key)=)[^&#]*", re.IGNORECASE)


def hide_password(url: str) -> str:
    """``rtsp://user:secret@host?token=secret`` without the secrets: descriptions end up in logs."""
    return _QUERY.sub(r"\1...", _USER.sub(r"\1:...@", url))
