"""Servers of pages: a request that cannot be answered is one line, and the next one is served."""

import socket
from http.server import BaseHTTPRequestHandler

import pytest
from structlog.testing import capture_logs

from semantic_mapper.nodes.local_server import LocalServer
from semantic_mapper.nodes.viewer.server import quiet_page


class Handler(BaseHTTPRequestHandler):
    """Fails for one path."""

    def do_GET(self) -> None:
        if self.path == "/bad":
            raise ValueError("a bug")
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Nothing."""


def status(port: int, request: bytes) -> bytes:
    """The first line of an answer; empty without an answer."""
    with socket.create_connection(("127.0.0.1", port), 30) as client:
        client.sendall(request + b"\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        return client.makefile("rb").readline().strip()


def test_a_request_that_fails_is_one_line_and_the_next_is_served(capfd: pytest.CaptureFixture[str]) -> None:
    with LocalServer(0, Handler) as server, capture_logs() as told:
        assert status(server.port, b"GET /bad HTTP/1.1") == b""
        assert status(server.port, b"GET /good HTTP/1.1").split()[1] == b"204"
        assert [(entry["event"], entry["reason"]) for entry in told] == [("request_not_served", "ValueError: a bug")]
        told.clear()
        for path in (b"/\xff\xfe", "/é".encode(), b"/" + b"9" * 5000, b"/%00", b"/\x01"):
            with quiet_page(0, server.port, "") as page:
                answer = status(page.port, b"GET " + path + b" HTTP/1.1")
                assert status(page.port, b"GET / HTTP/1.1").split()[1] == b"204"
            assert not answer or answer.split()[1] in (b"204", b"400"), path
    assert not [entry for entry in told if entry["event"] == "request_not_served"]
    assert "Traceback" not in capfd.readouterr().err
