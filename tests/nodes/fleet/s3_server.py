"""A real S3 server, `rclone serve s3` over a folder, and a proxy before it that injects faults by a seeded plan.

The proxy also mends in what rclone 1.75 differs from Amazon's S3: rclone passes over ``If-None-Match: *``, so that the
second writer replaces the first one's object, and it answers with 200 and the whole object's checksum where a part was
asked for.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Literal
from urllib.parse import unquote, urlsplit

import fsspec
import pytest

from research.experiments.ray_nodes import free_port

ACCESS_KEY, SECRET_KEY = "fleet-test", "fleet-test-secret"
_START_TIMEOUT_S = 30.0
_SLOW_PIECES, _SLOW_PIECE_S = 8, 0.05
_NOT_FORWARDED = ("connection", "transfer-encoding", "content-length", "expect", "keep-alive")

Fault = Literal["passed", "error", "slow", "cut", "lost"]


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """Fractions of requests that fail, by kind; together 1 at most.

    Attributes:
        seed: Of the random draws.
        error: Answered with 500 or 503; the server never sees them.
        slow: Answered in pieces, with pauses.
        cut: The connection ends in the middle of the answer's body.
        lost: The server does what it is asked to, and the connection ends before any answer.
        in_a_row: Faults of one method and path, after which the next request passes: clients give up at some point.
    """

    seed: int
    error: float = 0.0
    slow: float = 0.0
    cut: float = 0.0
    lost: float = 0.0
    in_a_row: int = 2


@dataclass
class S3Server:
    """A server that runs.

    Attributes:
        url: ``http://127.0.0.1:PORT``.
        folder: Its buckets are the folders in it.
        counts: Requests by what happened to them.
        requests: Method, path and what happened, in order.
    """

    url: str
    folder: Path
    counts: Counter[Fault] = field(default_factory=Counter)
    requests: list[tuple[str, str, Fault]] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """Variables by which fsspec and AWS's library find it, with the keys it takes.

        fsspec reads them when it is imported; a process that has imported it calls ``use`` instead.
        """
        return {
            "AWS_ACCESS_KEY_ID": ACCESS_KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET_KEY,
            "AWS_DEFAULT_REGION": "us-east-1",
            "FSSPEC_S3_ENDPOINT_URL": self.url,
        }

    def use(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Let ``s3://`` URLs of this process, and of those it starts, mean this server, to the end of the test."""
        for name, value in self.environment.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setitem(fsspec.config.conf, "s3", {"endpoint_url": self.url})
        fsspec.get_filesystem_class("s3").clear_instance_cache()


@contextlib.contextmanager
def failing_s3_server(plan: FaultPlan, *buckets: str) -> Iterator[S3Server]:
    """moto's S3 server on free ports of loopback, behind the proxy; it keeps objects in memory.

    rclone 1.75 stops answering where a PUT is repeated at once, as after a lost answer.

    Args:
        plan: Which requests fail.
        buckets: That are there.
    """
    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with (
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as moto,
        tempfile.TemporaryDirectory() as empty,
    ):
        try:
            _wait_for_port(moto, port)
            for bucket in buckets:
                _forwarded(f"http://127.0.0.1:{port}", "PUT", f"/{bucket}", {}, b"")
            with _proxy(f"http://127.0.0.1:{port}", Path(empty), plan) as server:
                yield server
        finally:
            moto.kill()


def _wait_for_port(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            if process.poll() is not None or time.monotonic() > deadline:
                raise
            time.sleep(0.1)
        else:
            return


@contextlib.contextmanager
def s3_server(folder: Path, plan: FaultPlan | None = None) -> Iterator[S3Server]:
    """Serve a folder on free ports of loopback.

    Args:
        folder: Whose folders are the buckets.
        plan: Which requests fail; None = none.
    """
    port = free_port()
    program = Path(sys.executable).parent / "rclone"
    command = [str(program), "serve", "s3", "--addr", f"127.0.0.1:{port}", "--auth-key", f"{ACCESS_KEY},{SECRET_KEY}"]
    # What another process writes into the folder is seen at once. With 0s, rclone spins on its timers.
    command += ["--dir-cache-time", "1ms", "--config", os.devnull, str(folder)]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as rclone:
        try:
            _wait(rclone, port)
            with _proxy(f"http://127.0.0.1:{port}", folder, plan or FaultPlan(seed=0)) as server:
                yield server
        finally:
            rclone.kill()


@contextlib.contextmanager
def _proxy(upstream: str, folder: Path, plan: FaultPlan) -> Iterator[S3Server]:
    """Forward requests to rclone, some of them not as they should be."""
    draws, drawing, creating = random.Random(plan.seed), threading.Lock(), threading.Lock()
    failed: Counter[tuple[str, str]] = Counter()
    kinds: tuple[Fault, ...] = ("error", "slow", "cut", "lost", "passed")
    weights = [plan.error, plan.slow, plan.cut, plan.lost]
    weights.append(1.0 - sum(weights))

    def fault_of(method: str, path: str) -> Fault:
        with drawing:
            (kind,) = draws.choices(kinds, weights)
            if failed[method, path] >= plan.in_a_row:
                kind = "passed"
            failed[method, path] = 0 if kind in ("passed", "slow") else failed[method, path] + 1
            server.counts[kind] += 1
            server.requests.append((method, path, kind))
            return kind

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _relay(self) -> None:
            with contextlib.suppress(ConnectionError):  # clients leave, too
                self._relay_one()

        def _relay_one(self) -> None:
            body = self._body()
            kind = fault_of(self.command, self.path)
            if kind == "error":
                code = draws.choice((500, 503))
                self._answer(code, {"Content-Type": "application/xml"}, _error_body(code), pause_s=0.0)
                return
            code, headers, answer = self._forwarded(body)
            if kind == "lost" or (kind == "cut" and not answer):
                self._end_connection()
                return
            length = len(answer)
            if self.command == "HEAD":
                headers, answer = {**headers, "Content-Length": headers.get("Content-Length", "0")}, b""
            elif kind == "cut":
                headers, answer = {**headers, "Content-Length": str(length)}, answer[: length // 2]
            self._answer(code, headers, answer, pause_s=_SLOW_PIECE_S if kind == "slow" else 0.0)
            if kind == "cut":
                self._end_connection()

        def _forwarded(self, body: bytes) -> tuple[int, dict[str, str], bytes]:
            request = (upstream, self.command, self.path, dict(self.headers), body)
            if self.headers.get("If-None-Match") != "*":
                return _forwarded(*request)
            with creating:
                if (folder / unquote(urlsplit(self.path).path).lstrip("/")).exists():
                    return 412, {"Content-Type": "application/xml"}, _error_body(412)
                return _forwarded(*request)

        do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = _relay  # noqa: N815  (names of BaseHTTPRequestHandler)

        def _body(self) -> bytes:
            if self.headers.get("Transfer-Encoding", "").lower() != "chunked":
                return self.rfile.read(int(self.headers.get("Content-Length", 0)))
            pieces = []
            while size := int(self.rfile.readline().split(b";")[0], 16):
                pieces.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(pieces)

        def _answer(self, code: int, headers: dict[str, str], body: bytes, *, pause_s: float) -> None:
            self.send_response_only(code)
            for name, value in {"Content-Length": str(len(body)), **headers}.items():
                self.send_header(name, value)
            self.end_headers()
            size = max(1, -(-len(body) // _SLOW_PIECES)) if pause_s else len(body) or 1
            for start in range(0, len(body), size):
                self.wfile.write(body[start : start + size])
                time.sleep(pause_s)

        def _end_connection(self) -> None:
            self.close_connection = True
            with contextlib.suppress(OSError):
                self.connection.shutdown(socket.SHUT_RDWR)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  (name of BaseHTTPRequestHandler)
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as listener:
        server = S3Server(f"http://127.0.0.1:{listener.server_address[1]}", folder)
        listener.daemon_threads = True
        thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            listener.shutdown()
            thread.join()


def _forwarded(
    url: str, method: str, path: str, headers: dict[str, str], body: bytes
) -> tuple[int, dict[str, str], bytes]:
    """The server's answer. The host stays the client's, because it is part of the signature."""
    upstream = http.client.HTTPConnection(url.removeprefix("http://"), timeout=60)
    try:
        upstream.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            if name.lower() not in _NOT_FORWARDED:
                upstream.putheader(name, value)
        upstream.putheader("Content-Length", str(len(body)))
        upstream.endheaders(body)
        answer = upstream.getresponse()
        content = answer.read()
        kept = {name: value for name, value in answer.getheaders() if name.lower() not in _NOT_FORWARDED}
        status = answer.status
        if "Content-Range" in kept:
            status = HTTPStatus.PARTIAL_CONTENT
            kept = {name: value for name, value in kept.items() if not name.lower().startswith("x-amz-checksum")}
        if method == "HEAD":
            kept["Content-Length"] = answer.getheader("Content-Length", "0")
        return status, kept, content
    finally:
        upstream.close()


def _error_body(code: int) -> bytes:
    name = {500: "InternalError", 503: "SlowDown", 412: "PreconditionFailed"}[code]
    condition = "<Condition>If-None-Match</Condition>" if code == 412 else ""
    return f"<?xml version='1.0'?><Error><Code>{name}</Code><Message>by the proxy</Message>{condition}</Error>".encode()


def _wait(server: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + _START_TIMEOUT_S
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return
        if server.poll() is not None or time.monotonic() > deadline:
            server.kill()
            assert server.stderr is not None
            raise RuntimeError(f"rclone serve s3 did not start: {server.stderr.read().decode(errors='replace')}")
        time.sleep(0.05)
