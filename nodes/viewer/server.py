"""Rerun's own web viewer, served to browsers of this machine by a process of its own.

The SDK could serve it from within this process, but on all interfaces; the program that comes with it listens where it
is instructed to. It never calls home: analytics are switched off in a folder of settings that it alone uses, and the
browser gets its pages through ``quiet_page``. What is seen has neither keys nor passwords: other machines come in by
`ssh -L`.
"""

from __future__ import annotations

import http.client
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import TYPE_CHECKING, Self
from urllib.parse import quote

import rerun_cli
import structlog

from semantic_mapper.errors import DependencyError, TransportError
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.launcher.liveness import end_with_launcher
from semantic_mapper.nodes.local_server import HOST, LocalServer, open_browser
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.transport.process_folder import OwnFolder

if TYPE_CHECKING:
    from rerun import RecordingStream

    from semantic_mapper.mapping.pipeline import MappingPipeline
    from semantic_mapper.replay.rerun_log import RerunLog

PROGRAM = Path(rerun_cli.__file__).with_name("rerun")  # comes with the SDK
WEB_PORT, DATA_PORT = 9090, 9876
START_S = 120.0  # on a machine that has too much to do
STOP_S = 3.0
TIMEOUT_S = 10.0  # of one request
_POLL_S = 0.05
_KEPT = ("Content-Type", "Content-Length", "rerun-final-length")  # headers that are passed on
_OUTSIDE = re.compile(rb"<link\b[^>]*\bhref=[\"']?https?:[^>]*>")  # links of a page to other machines

_log = structlog.get_logger(__name__)


class WebViewer(ExitStack):
    """A web server with the viewer, and a data server that keeps what browsers are shown; a context manager.

    ``port`` is that of the page: 0 = any that is free; None = the usual one, or any where that is taken, which the data
    server has unless ``port`` is 0. ``memory_mb`` is what it may keep for browsers that come later.
    """

    def __init__(self, port: int | None = None, memory_mb: int = 512) -> None:
        super().__init__()
        self._port = port
        self._memory_mb = memory_mb
        self.data_url = ""  # where to send what is to be shown
        self.page_url = ""  # what to open in a browser
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        """Start the servers and wait until they answer: ``DependencyError``, ``TransportError`` where they do not."""
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    @property
    def pid(self) -> int:
        """Of the servers' process."""
        assert self._process is not None
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it still serves."""
        return self._process is not None and self._process.poll() is None

    def _start(self) -> None:
        folder = self.enter_context(closing(OwnFolder("view-"))).path  # where we are killed, `up` removes it
        settings = {f"XDG_{kind}_HOME": f"{folder}/{kind.lower()}" for kind in ("CONFIG", "DATA", "CACHE")}
        environment = {**os.environ, **settings}
        result = subprocess.run([PROGRAM, "analytics", "disable"], env=environment, capture_output=True, check=False)
        if result.returncode != 0:  # then it would call home
            raise DependencyError(f"{PROGRAM}: analytics cannot be switched off: {result.stderr.decode().strip()}")
        # Ports are held until all are chosen: one that was let go may be given out again.
        data_port = 0 if self._port == 0 else None
        with (
            _hold_port(self._port, WEB_PORT) as port,
            _hold_port(data_port, DATA_PORT) as data,
            _hold_port(0, 0) as web,
        ):
            pass
        page = self.enter_context(quiet_page(port, web, f"http://{HOST}:{data}"))
        self.data_url = f"rerun+http://{HOST}:{data}/proxy"
        shown = f"url={quote(self.data_url, safe='')}&hide_welcome_screen=1&persist=0&theme=dark"
        self.page_url = f"http://{HOST}:{page.port}/?{shown}"
        command = [str(PROGRAM), "--serve-web", "--bind", HOST, "--port", str(data), "--web-viewer-port", str(web)]
        command += ["--server-memory-limit", f"{self._memory_mb}MB"]
        log = folder / "log"
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                process_group=0,  # Ctrl-C is for us; we end it
                preexec_fn=end_with_launcher,  # and where we are killed, the kernel does
            )
        self.callback(end_process, self._process)
        deadline = time.monotonic() + START_S
        while not (_answers(web) and _answers(data)):
            if not self.alive or time.monotonic() > deadline:
                words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-3:]
                raise TransportError(f"the web viewer has not started; its last words: {' | '.join(words) or 'none'}")
            time.sleep(_POLL_S)


class ViewerPage(WebViewer):
    """The page, whose address is printed, and opened in a browser of this desktop, once there is something on it."""

    def __init__(self, output: Output, port: int | None = None) -> None:
        super().__init__(port)
        self._output = output

    def begin(self) -> RecordingStream:
        """What writes on it."""
        from semantic_mapper.replay.rerun_log import recording_server  # loads for a second

        self._output.address("watch at", self.page_url)
        open_browser(self.page_url)
        stream = recording_server(self.data_url)
        self.callback(stream.disconnect)  # before its server ends, which it would complain of at length
        return stream

    def watch(self, pipeline: MappingPipeline) -> RerunLog:
        """What shows a session with this pipeline on it."""
        from semantic_mapper.nodes.viewer.sources import WatchedSession

        return WatchedSession(self.begin, pipeline)

    def wait(self, stop: StopRequest) -> None:
        """Serve it until somebody asks to stop. Raises TransportError: its server has ended."""
        while not stop:
            if not self.alive:
                raise TransportError("the process that serves the viewer has ended; start it again")
            time.sleep(_POLL_S)


def end_process(process: subprocess.Popen[bytes]) -> None:
    """Ask a process to end, and kill it where it does not."""
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def _hold_port(port: int | None, usual: int) -> Iterator[int]:
    """The port itself where it is free, a free one for 0, for None the usual one where it is free; kept from others."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, usual if port is None else port))
        except OSError as error:
            if port is not None:
                raise TransportError(
                    f"port {port} cannot be had ({error.strerror}); give another one with --port, or 0 for any"
                ) from error
            probe.bind((HOST, 0))
        yield probe.getsockname()[1]


def _answers(port: int) -> bool:
    with socket.socket() as client:
        client.settimeout(1.0)
        return client.connect_ex((HOST, port)) == 0


def quiet_page(port: int, source: int, allowed: str) -> LocalServer:
    """Serve the pages of another server of this machine with the order to speak to nobody else.

    Rerun's viewer reports its use and looks for newer releases, whatever its settings. A content security policy is
    what a browser obeys, but no policy stops it from connecting ahead of the font that the page links to: such links
    are blanked. ``source`` is the port of the other server, ``allowed`` an origin that the page may fetch from, too.
    """
    policy = (
        "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:; "
        f"connect-src 'self' data: blob: {allowed}; form-action 'none'; base-uri 'self'"
    )
    headers = {"Content-Security-Policy": policy, "Referrer-Policy": "no-referrer"}

    class Handler(BaseHTTPRequestHandler):
        """One request."""

        timeout = TIMEOUT_S

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if not path.isascii():
                self.send_error(HTTPStatus.BAD_REQUEST, "addresses are ASCII")
                return
            with closing(http.client.HTTPConnection(HOST, source, timeout=TIMEOUT_S)) as connection:
                try:
                    connection.request("GET", path)
                    answer = connection.getresponse()
                    kept = {name: answer.headers[name] for name in _KEPT if name in answer.headers}
                    self.send_response(answer.status)
                    for name, value in (kept | headers).items():
                        self.send_header(name, value)
                    self.end_headers()
                    if kept.get("Content-Type", "").startswith("text/html"):  # blanks keep the length that was said
                        self.wfile.write(_OUTSIDE.sub(lambda link: b" " * len(link[0]), answer.read()))
                    shutil.copyfileobj(answer, self.wfile)
                except (OSError, http.client.HTTPException) as error:  # the browser has left, or the server has ended
                    _log.debug("page_not_served", path=self.path, reason=str(error))

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (its name there)
            _log.debug("page_served", request=format % args)

    return LocalServer(port, Handler)
