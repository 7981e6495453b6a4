"""Token and TLS of a cluster, with the commands that the documentation gives."""

from __future__ import annotations

import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from conftest import REPOSITORY
from research.experiments.ray_nodes import RayNodes, ray_nodes
from tests.nodes.fleet.test_cluster import join

pytest.importorskip("ray")

NAMES = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN_PATH", "RAY_USE_TLS", "RAY_TLS_CA_CERT")
NAMES += ("RAY_TLS_SERVER_CERT", "RAY_TLS_SERVER_KEY")
# Prints the nodes that tasks ran on.
SPREADING = """
import os, sys, time
import ray
from semantic_mapper.nodes.fleet.cluster import connected

def where():
    time.sleep(0.5)
    return ray.get_runtime_context().get_node_id()

with connected(sys.argv[1]) as cluster:
    task = ray.remote(where).options(num_cpus=1, scheduling_strategy="SPREAD")
    print(cluster.nodes, len(set(ray.get([task.remote() for _ in range(8)]))))
"""


@pytest.fixture(scope="module")
def variables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the documentation's commands export for a node at 127.0.0.1."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("tls")
    text = (REPOSITORY / "docs" / "fleet-cluster.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    script = "\n".join(["set -e", *blocks, *(f'echo "{name}=${name}"' for name in NAMES)])
    environment = {**os.environ, "NODE": "127.0.0.1"}
    done = subprocess.run(["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = dict(line.split("=", 1) for line in done.stdout.splitlines() if line.startswith("RAY_"))
    assert set(found) == set(NAMES)
    return found


@pytest.fixture(scope="module")
def nodes(variables: dict[str, str]) -> Iterator[RayNodes]:
    """A head and a node, one CPU each, as processes of their own."""
    with ray_nodes(head_cpus=1, worker_cpus=(1,), environment=variables) as started:
        yield started


def ports(nodes: RayNodes) -> list[int]:
    """Those of Ray's own servers; its runtime environment agent speaks HTTP without TLS."""
    found: set[int] = set()
    for process in nodes.processes():
        if process.name() in ("gcs_server", "raylet"):
            connections = process.net_connections(kind="inet")
            found |= {c.laddr.port for c in connections if c.status == psutil.CONN_LISTEN}
    return sorted(found)


def handshake(port: int, context: ssl.SSLContext) -> bool:
    """Whether a server takes a client: with TLS 1.3 it says so only once it is asked something."""
    address = ("127.0.0.1", port)
    with socket.create_connection(address, timeout=10) as plain:
        try:
            with context.wrap_socket(plain, server_hostname="localhost") as secured:
                return len(secured.recv(1)) == 1
        except (ssl.SSLError, ConnectionError):
            return False


@pytest.mark.slow
def test_keys_are_for_this_user_only(variables: dict[str, str]) -> None:
    folder = Path(variables["RAY_AUTH_TOKEN_PATH"]).parent
    assert folder.stat().st_mode & 0o777 == 0o700
    assert len(Path(variables["RAY_AUTH_TOKEN_PATH"]).read_text().strip()) == 64
    assert all(path.stat().st_mode & 0o077 == 0 for path in folder.iterdir())


@pytest.mark.slow
def test_tasks_run_on_both_nodes_with_token_and_tls(nodes: RayNodes, variables: dict[str, str]) -> None:
    command = [sys.executable, "-c", SPREADING, nodes.address]
    done = subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=180)
    assert done.stdout.split() == ["2", "2"], done.stderr


@pytest.mark.slow
def test_every_server_of_ray_asks_for_a_certificate(nodes: RayNodes, variables: dict[str, str]) -> None:
    certified = ssl.create_default_context(cafile=variables["RAY_TLS_CA_CERT"])
    certified.set_alpn_protocols(["h2"])
    certified.load_cert_chain(variables["RAY_TLS_SERVER_CERT"], variables["RAY_TLS_SERVER_KEY"])
    without = ssl.create_default_context(cafile=variables["RAY_TLS_CA_CERT"])
    without.set_alpn_protocols(["h2"])
    assert len(ports(nodes)) == 5  # the head's tables; two of each raylet
    for port in ports(nodes):
        assert handshake(port, certified)
        assert not handshake(port, without)


@pytest.mark.slow
def test_with_certificate_but_without_token_nobody_joins(nodes: RayNodes, variables: dict[str, str]) -> None:
    without_token = {name: value for name, value in variables.items() if "AUTH" not in name}
    assert "asks for another token" in join(nodes.address, **without_token)


@pytest.mark.slow
def test_with_token_but_without_tls_nobody_joins(nodes: RayNodes, variables: dict[str, str]) -> None:
    without_tls = {name: value for name, value in variables.items() if "AUTH" in name}
    assert "refused" in join(nodes.address, **without_tls)
