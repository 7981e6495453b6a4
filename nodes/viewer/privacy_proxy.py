"""A page of a server on this machine, passed on to browsers with the order to speak to nobody else.

Rerun's viewer reports its use, looks for newer releases and loads a font, whatever its settings. A content security
policy is what a browser obeys.
"""

from __future__ import annotations

import http.client
import shutil
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler

import structlog

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.local_server import LocalServer

TIMEOUT_S = 10.0
_KEPT = ("Content-Type", "Content-Length", "rerun-final-length")  # headers that are passed on

_log = structlog.get_logger(__name__)


class QuietPage:
    """Serves another server's pages, in threads of its own.

    Args:
        address: Where; port 0 = any that is free.
        source: Host and port of the other server.
        allowed: Origins that the page may fetch from, in addition to this server.

    Raises:
        TransportError: the port is taken.
    """

    def __init__(self, address: tuple[str, int], source: tuple[str, int], allowed: tuple[str, ...]) -> None:
        own = "'self'"
        policy = (
            f"default-src {own} 'unsafe-inline' 'wasm-unsafe-eval' data: blob:; "
            f"connect-src {' '.join((own, 'data:', 'blob:', *allowed))}; "
            "form-action 'none'; base-uri 'self'"
        )
        try:
            self._server = LocalServer(address, _make_handler(source, policy))
        except OSError as error:
            raise TransportError(f"port {address[1]} cannot be had: {error.strerror}; choose another one") from error
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="web page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def _make_handler(source: tuple[str, int], policy: str) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """One request."""

        timeout = TIMEOUT_S

        def do_GET(self) -> None:
            connection = http.client.HTTPConnection(*source, timeout=TIMEOUT_S)
            path = self.path.partition("?")[0]
            if not path.isascii():
                self.send_error(HTTPStatus.BAD_REQUEST, "addresses are ASCII")
                return
            try:
                connection.request("GET", path)
                answer = connection.getresponse()
                self.send_response(answer.status)
                for name in _KEPT:
                    if (value := answer.headers.get(name)) is not None:
                        self.send_header(name, value)
                self.send_header("Content-Security-Policy", policy)
                self.send_header("Referrer-Policy", "no-referrer")
                self.end_headers()
                shutil.copyfileobj(answer, self.wfile)
            except (OSError, http.client.HTTPException) as error:  # the browser has left, or the server has ended
                _log.debug("page_not_served", path=self.path, reason=str(error))
            finally:
                connection.close()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (its name there)
            _log.debug("page_served", request=format % args)

    return Handler
