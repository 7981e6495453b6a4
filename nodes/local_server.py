"""Pages that are served to browsers of this machine."""

import os
import sys
import threading
import webbrowser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import structlog

from semantic_mapper.errors import TransportError

HOST = "127.0.0.1"

_log = structlog.get_logger(__name__)


class LocalServer(ThreadingHTTPServer):
    """Serves each request in a thread, from when it is made until the context ends; a request that fails is one line in
    the log, and the next one is served.

    ``port`` 0 = any that is free. Raises TransportError: the port is taken.
    """

    daemon_threads = True

    def __init__(self, port: int, handler: type[BaseHTTPRequestHandler]) -> None:
        try:
            super().__init__((HOST, port), handler)
        except OSError as error:
            raise TransportError(
                f"port {port} cannot be had ({error.strerror}); give another one with --port, or 0 for any"
            ) from error
        self.port = int(self.server_address[1])
        self._thread = threading.Thread(target=self.serve_forever, name="web page", daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self._thread.join()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A request that its handler could not answer, such as of a browser that has left."""
        error = sys.exc_info()[1]
        report = _log.debug if isinstance(error, OSError) else _log.warning
        report("request_not_served", reason=f"{type(error).__name__}: {error}")


def open_browser(url: str) -> None:
    """Show a page in a browser of this desktop; without a desktop, as behind ssh, say where it is."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)
    else:  # it would start a text browser in this terminal
        _log.info("browser_not_opened", reason="no desktop", page=url)
