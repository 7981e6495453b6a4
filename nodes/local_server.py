"""Pages that are served to browsers of this machine."""

from __future__ import annotations

import sys
from http.server import ThreadingHTTPServer
from typing import Any

import structlog

_log = structlog.get_logger(__name__)


class LocalServer(ThreadingHTTPServer):
    """Serves each request in a thread; one that fails is one line in the log, and the next one is served."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A request that its handler could not answer, such as of a browser that has left."""
        error = sys.exc_info()[1]
        report = _log.debug if isinstance(error, OSError) else _log.warning  # the browser has left
        report("request_not_served", reason=f"{type(error).__name__}: {error}")
