"""The labelling page of one log, served to browsers of this machine that know the token in its address.

The page is on loopback alone, and its policy lets it speak to nobody but this server. Other pages that a browser has
open cannot reach it: they lack the token, and names that somebody has bound to this machine's address are refused.
"""

import hashlib
import hmac
import json
import math
import re
import secrets
import threading
from collections.abc import Sequence
from dataclasses import replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import structlog

from semantic_mapper.errors import FrameError, LabelError, LogError
from semantic_mapper.nodes.local_server import HOST, LocalServer
from semantic_mapper.replay.label_folder import LabelFolder
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.training.strokes import grow_strokes
from semantic_mapper.types import PosedFrame

PORT = 9092
JPEG_QUALITY = 95
TIMEOUT_S = 10.0  # of one read or write of a request
_PAGE = Path(__file__).parent / "page"
_FILES = {
    "": ("index.html", "text/html; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
    "strokes.js": ("strokes.js", "text/javascript; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
}
_FRAME = re.compile(r"frames/([0-9]{1,9})/(image|label|grown)")
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}

_log = structlog.get_logger(__name__)


class ChangedElsewhereError(LabelError):
    """A label image is no longer what it was when the page showed it."""


def revision_of(label: bytes) -> str:
    """Tells one state of a label image from another."""
    return hashlib.sha256(label).hexdigest()[:32]


class LabelSession:
    """One log being labelled. Any thread may call.

    Methods that take the number of a frame raise ``LogError`` or ``FrameError`` where there is no such frame, or it or
    its label image is damaged. Labels are class ids of the pixels, row by row, a byte each; the ignore id where nothing
    is labelled.

    ``log`` is open as long as the session; ``order`` has the numbers of the frames to label, as the page shows them.
    """

    def __init__(self, log: Log, folder: LabelFolder, order: Sequence[int]) -> None:
        self._log, self._folder, self._order = log, folder, list(order)
        self._sizes: dict[int, tuple[int, int]] = {}
        self._lock = threading.RLock()

    def describe(self) -> dict[str, Any]:
        """What the page shows: plain data."""
        labels = self._folder.label_set
        classes = zip(labels.ids, labels.names, labels.colors, strict=True)
        return {
            "log": self._log.path.name,
            "folder": str(self._folder.path),
            "frames": len(self._log),
            "order": self._order,
            "labelled": self._folder.numbers(),
            "ignore": labels.ignore_id,
            "classes": [{"id": i, "name": name, "color": list(color)} for i, name, color in classes],
        }

    def image(self, number: int) -> bytes:
        """Colour image of a frame, as JPEG."""
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        return cv2.imencode(".jpg", cv2.cvtColor(self._frame(number).rgb, cv2.COLOR_RGB2BGR), options)[1].tobytes()

    def label(self, number: int) -> bytes:
        """Label of a frame."""
        with self._lock:
            size = self.size(number)
            if number in self._folder.numbers():
                return self._folder.read(number, size).tobytes()
            return np.full(size, self._folder.label_set.ignore_id, np.uint8).tobytes()

    def grown(self, number: int) -> bytes:
        """What the strokes of a frame grow to, as a label."""
        with self._lock:
            label = np.frombuffer(self.label(number), np.uint8).reshape(self.size(number))
            frame = replace(self._frame(number), label=label)
        grown = grow_strokes(frame, self._folder.label_set).label
        assert grown is not None
        return grown.tobytes()

    def save(self, number: int, data: bytes, revision: str | None = None) -> None:
        """Write a label, as changed by a person.

        Raises ChangedElsewhereError: somebody else has changed it since. LabelError: not a byte a pixel, or an id that
        is no class. LogError: it cannot be written.

        ``revision`` is ``revision_of`` what the person changed; None = whatever is there is replaced.
        """
        with self._lock:
            height, width = self.size(number)
            if len(data) != height * width:
                raise LabelError(f"frame {number}: {len(data):,} bytes for {width}x{height} pixels; send one a pixel")
            if revision is not None and revision != revision_of(self.label(number)):
                raise ChangedElsewhereError(f"frame {number} was changed elsewhere, in another tab or by a program")
            self._folder.write(number, np.frombuffer(data, np.uint8).reshape(height, width))

    def size(self, number: int) -> tuple[int, int]:
        """Height and width of a frame."""
        if number not in self._sizes:
            self._frame(number)
        return self._sizes[number]

    def _frame(self, number: int) -> PosedFrame:
        if not 0 <= number < len(self._log):
            raise LogError(f"{self._log.path}: has no frame {number}; it has {len(self._log)}")
        with self._lock:
            frame = self._log.frame(number)
        self._sizes[number] = frame.intrinsics.height, frame.intrinsics.width
        return frame


class LabelServer(LocalServer):
    """Serves one session at ``url``; 0 for any port that is free."""

    def __init__(self, session: LabelSession, port: int = PORT) -> None:
        token = secrets.token_urlsafe(24)
        super().__init__(port, _make_handler(session, token))
        self.url = f"http://{HOST}:{self.port}/{token}/"


class _RefusedError(Exception):
    """A request that is answered by a status and a sentence."""

    def __init__(self, status: HTTPStatus, message: str) -> None:
        super().__init__(message)
        self.status = status


def _make_handler(session: LabelSession, token: str) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """One request."""

        timeout = TIMEOUT_S

        def do_GET(self) -> None:
            self._answer(self._get)

        def do_PUT(self) -> None:
            self._answer(self._put)

        def _answer(self, method: Any) -> None:
            try:
                self._send(HTTPStatus.OK, *method(self._path()))
            except _RefusedError as error:
                self._refuse(error.status, str(error))
            except ChangedElsewhereError as error:
                self._refuse(HTTPStatus.PRECONDITION_FAILED, str(error))
            except (LabelError, LogError, FrameError) as error:
                self._refuse(HTTPStatus.BAD_REQUEST, str(error))

        def _path(self) -> str:
            """What is requested, behind the token; refused is who may not."""
            host = self.headers.get("Host", "")  # of a tunnel, the port may be another
            own = f"http://{host}"
            if host.rpartition(":")[0] not in (HOST, "localhost") or self.headers.get("Origin", own) != own:
                raise _RefusedError(HTTPStatus.FORBIDDEN, f"the page is at {HOST} or localhost")
            given, slash, path = self.path.removeprefix("/").partition("/")
            if not hmac.compare_digest(given.encode(), token.encode()):
                raise _RefusedError(HTTPStatus.FORBIDDEN, "open the address that `label --serve` has shown")
            if not slash:
                raise _RefusedError(HTTPStatus.NOT_FOUND, "the address ends in a slash: /TOKEN/")
            return path

        def _get(self, path: str) -> tuple[bytes, str] | tuple[bytes, str, str]:
            if path in _FILES:
                name, kind = _FILES[path]
                return (_PAGE / name).read_bytes(), kind
            if path == "session":
                return json.dumps(session.describe()).encode(), "application/json"
            number, what = _frame(path)
            if what == "image":
                return session.image(number), "image/jpeg"
            if what == "grown":
                return session.grown(number), "application/octet-stream"
            label = session.label(number)
            return label, "application/octet-stream", revision_of(label)

        def _put(self, path: str) -> tuple[bytes, str, str]:
            number, what = _frame(path)
            if what != "label":
                raise _RefusedError(HTTPStatus.METHOD_NOT_ALLOWED, "only labels can be written")
            length = self.headers.get("Content-Length", "")
            if not length.isascii() or not length.isdigit():
                raise _RefusedError(HTTPStatus.LENGTH_REQUIRED, "say how long the label is")
            if length.lstrip("0") != str(pixels := math.prod(session.size(number))):
                said = f"frame {number} has {pixels} pixels, and got {length:.20}"
                raise _RefusedError(HTTPStatus.BAD_REQUEST, said)
            label, seen = self.rfile.read(pixels), self.headers.get("If-Match")
            session.save(number, label, None if seen is None else seen.strip('"'))
            return b"{}", "application/json", revision_of(label)

        def _refuse(self, status: HTTPStatus, message: str) -> None:
            self.close_connection = True  # what it has sent is not read
            self._send(status, json.dumps({"error": message}).encode(), "application/json")

        def _send(self, status: HTTPStatus, body: bytes, kind: str, revision: str = "") -> None:
            headers = {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}
            headers |= {"ETag": f'"{revision}"'} if revision else {}
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (its name there)
            _log.debug("page_served", request=(format % args).replace(token, "TOKEN"))

    return Handler


def _frame(path: str) -> tuple[int, str]:
    found = _FRAME.fullmatch(path)
    if found is None:
        raise _RefusedError(HTTPStatus.NOT_FOUND, "no such page")
    return int(found[1]), found[2]
