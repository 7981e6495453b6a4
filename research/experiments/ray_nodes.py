"""A Ray cluster of several nodes on this machine, each a process of its own that can be killed."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import psutil

_START_TIMEOUT_S = 150.0
# By default a node gives up after 30 s, and after 15 s without its agent: too soon on a machine that has other work.
_PATIENT = {"RAY_raylet_start_wait_time_s": "120", "RAY_agent_register_timeout_ms": "120000"}
_HOST = "127.0.0.1"
# `ray start --node-ip-address=127.0.0.1` takes this machine's outer address instead, and any other address of loopback
# makes Ray listen everywhere. This program is `ray` without that exchange.
_RAY = """
import sys
from ray._private import services
from ray.scripts.scripts import main
services.resolve_ip_for_localhost = lambda host: host
sys.exit(main())
"""
_OBJECT_STORE_BYTES = 80 << 20  # a little more than the least that Ray takes


class RayNodes:
    """``ray start --block``, once a node; see ``ray_nodes``.

    Attributes:
        address: ``127.0.0.1:PORT`` of the head.
        folder: Ray's logs and sockets.
        environment: Variables that every node was started with, and that clients need, too: how the token is found.
    """

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self.address = f"{_HOST}:{free_port()}"
        self.folder = folder
        token = folder / "token"
        token.write_text(secrets.token_hex(32), encoding="ascii")
        token.chmod(0o600)
        self.environment = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), **environment}
        self._node_environment = {**_PATIENT, **self.environment}
        self._nodes: list[subprocess.Popen[bytes]] = []

    def start_head(self, *, cpus: int, options: tuple[str, ...] = ()) -> None:
        """Start the node that holds the cluster's tables, and wait until it runs."""
        port = self.address.rpartition(":")[2]
        # A head started without `--ray-client-server-port` opens port 10001, which other clusters may hold.
        extra = ("--include-dashboard=false", f"--ray-client-server-port={free_port()}", *options)
        head = self._start("--head", f"--port={port}", f"--num-cpus={cpus}", f"--temp-dir={self.folder}", *extra)
        self._wait(head)

    def start_worker(self, *, cpus: int, options: tuple[str, ...] = ()) -> int:
        """Start one more node, and wait until it runs: nodes that start at once take the same names for their sockets.

        Returns:
            Its index, for ``kill``.
        """
        node = self._start(f"--address={self.address}", f"--num-cpus={cpus}", *options)
        self._wait(node)
        return node

    def kill(self, node: int) -> None:
        """End a node and all its workers with SIGKILL, as a machine that loses power.

        Args:
            node: 0 = the head.
        """
        process = self._nodes[node]
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in (*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)):
                with contextlib.suppress(psutil.NoSuchProcess):
                    child.kill()
        process.wait()

    def kill_all(self) -> None:
        """End every node, workers first."""
        for node in reversed(range(len(self._nodes))):
            self.kill(node)

    def processes(self) -> list[psutil.Process]:
        """All processes of all nodes that live."""
        found: list[psutil.Process] = []
        for node in self._nodes:
            with contextlib.suppress(psutil.NoSuchProcess):
                process = psutil.Process(node.pid)
                found += [process, *process.children(recursive=True)]
        return found

    def _start(self, *options: str) -> int:
        index = len(self._nodes)
        command = [sys.executable, "-c", _RAY, "start", "--block", "--disable-usage-stats"]
        # Port 0 = any free one: by default every node on this machine would count up from the same.
        command += [
            f"--node-ip-address={_HOST}",
            "--min-worker-port=0",
            "--max-worker-port=0",
            f"--object-store-memory={_OBJECT_STORE_BYTES}",
        ]
        with self._log(index).open("wb") as file:
            node = subprocess.Popen(
                [*command, *options],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self._node_environment},
                start_new_session=True,
            )
        self._nodes.append(node)
        return index

    def _wait(self, node: int) -> None:
        log = self._log(node)
        deadline = time.monotonic() + _START_TIMEOUT_S
        while b"runtime started" not in log.read_bytes():
            if self._nodes[node].poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"node {node} of Ray did not start:\n{log.read_text(errors='replace')}")
            time.sleep(0.1)

    def _log(self, node: int) -> Path:
        return self.folder / f"node-{node}.log"


@contextlib.contextmanager
def ray_nodes(
    *,
    head_cpus: int,
    worker_cpus: tuple[int, ...] = (),
    head_options: tuple[str, ...] = (),
    environment: Mapping[str, str] | None = None,
) -> Iterator[RayNodes]:
    """A cluster on loopback, with free ports and a folder of its own; killed at the end.

    Args:
        head_cpus: Of the head; 0 = no task runs there.
        worker_cpus: Of every further node.
        head_options: Further options of the head's ``ray start``.
        environment: Further variables of all nodes, such as those of TLS.
    """
    # Ray's sockets lie in it, and their paths may be 107 bytes long at most: pytest's folders are too deep.
    folder = Path(tempfile.mkdtemp(prefix="ray-nodes-", dir="/tmp"))
    nodes = RayNodes(folder, environment or {})
    try:
        nodes.start_head(cpus=head_cpus, options=head_options)
        for cpus in worker_cpus:
            nodes.start_worker(cpus=cpus)
        yield nodes
    finally:
        nodes.kill_all()
        shutil.rmtree(folder, ignore_errors=True)


def free_port() -> int:
    """A TCP port of loopback that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
