"""Servers of pages: a request that cannot be answered is one line, and the next one is served."""

from __future__ import annotations

import socket
from collections.abc import Iterator
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


@pytest.fixture
def port() -> Iterator[int]:
    with LocalServer(0, Handler) as server:
        yield server.port


def status(port: int, request: bytes) -> bytes:
    """The first line of an answer; empty where there is none."""
    with socket.create_connection(("127.0.0.1", port), 30) as client:
        client.sendall(request + b"\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        return client.makefile("rb").readline().strip()


def test_a_request_that_fails_is_one_line_and_the_next_one_is_served(
    port: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with capture_logs() as told:
        assert status(port, b"GET /bad HTTP/1.1") == b""
        assert status(port, b"GET /good HTTP/1.1").split()[1] == b"204"
    assert [(entry["event"], entry["reason"]) for entry in told] == [("request_not_served", "ValueError: a bug")]
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("path", [b"/\xff\xfe", "/é".encode(), b"/" + b"9" * 5000, b"/%00", b"/\x01"])
def test_odd_addresses_are_refused_by_the_page_of_the_viewer(
    port: int, path: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    with quiet_page(0, port, "") as page, capture_logs() as told:
        answer = status(page.port, b"GET " + path + b" HTTP/1.1")
        assert status(page.port, b"GET / HTTP/1.1").split()[1] == b"204"
    assert not answer or answer.split()[1] in (b"204", b"400")
    assert not [entry for entry in told if entry["event"] == "request_not_served"]
    assert "Traceback" not in capfd.readouterr().err
