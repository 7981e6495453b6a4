from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import psutil
import pytest

from research.experiments.ray_nodes import RayNodes, free_port, ray_nodes
from semantic_mapper.errors import DependencyError, FleetError
from semantic_mapper.nodes.fleet import cluster
from semantic_mapper.nodes.fleet.cluster import connected

ray = pytest.importorskip("ray")

# Prints the folder of an embedded cluster, and waits inside it.
WAITING = """
import os, signal, sys, time
from pathlib import Path
from semantic_mapper.nodes.fleet.cluster import connected
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
with connected("local", cpus=1):
    print(Path(os.environ["RAY_AUTH_TOKEN_PATH"]).parent, flush=True)
    time.sleep(300)
"""
JOINING = """
import sys
from semantic_mapper.errors import FleetError
from semantic_mapper.nodes.fleet.cluster import connected
try:
    with connected(sys.argv[1]) as cluster:
        print("joined", cluster.nodes)
except FleetError as error:
    print("refused:", error)
"""


@pytest.fixture(scope="module")
def nodes() -> Iterator[RayNodes]:
    """A head without CPUs, and a node with one."""
    with ray_nodes(head_cpus=0, worker_cpus=(1,)) as started:
        yield started


def beyond_loopback(processes: list[psutil.Process]) -> list[tuple[str, str]]:
    open_ports = []
    for process in processes:
        try:
            open_ports += [
                (process.name(), c.laddr.ip)
                for c in process.net_connections(kind="inet")
                if c.status == psutil.CONN_LISTEN and c.laddr.ip.removeprefix("::ffff:") not in ("127.0.0.1", "::1")
            ]
        except psutil.NoSuchProcess:
            continue
    return open_ports


def process_id() -> int:
    return os.getpid()


def environment_of_ray() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith("RAY_") and "CLIENT_MODE" not in name}


def join(address: str, **variables: str) -> str:
    """What another process says that joins a cluster."""
    environment = {**{n: v for n, v in os.environ.items() if not n.startswith("RAY_")}, **variables}
    command = [sys.executable, "-c", JOINING, address]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_an_embedded_cluster_runs_tasks_on_loopback_only_and_leaves_nothing(tmp_path: Path) -> None:
    before = environment_of_ray()
    others = psutil.Process().children(recursive=True)  # such as the resource tracker of multiprocessing
    home = tmp_path / "home"
    home.mkdir()
    os.environ["HOME"] = str(home)
    with connected(None, cpus=1) as joined:
        assert joined.embedded
        assert (joined.nodes, joined.cpus) == (1, 1.0)
        assert joined.memory_bytes > 0
        worker = ray.get(ray.remote(process_id).remote())
        assert worker != os.getpid()
        started = [child for child in psutil.Process().children(recursive=True) if child not in others]
        processes = [psutil.Process(), *started]
        assert worker in {process.pid for process in processes}
        assert beyond_loopback(processes) == []
        token = Path(os.environ["RAY_AUTH_TOKEN_PATH"])
        assert token.stat().st_mode & 0o777 == 0o600
        assert token.parent.stat().st_mode & 0o777 == 0o700
        assert token.read_text() not in " ".join(" ".join(process.cmdline()) for process in processes)
    assert not ray.is_initialized()
    assert not token.parent.exists()
    assert list(home.iterdir()) == []
    assert environment_of_ray() == before
    assert not [process for process in started if process.is_running() and process.status() != "zombie"]


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("ray://10.0.0.1:10001", "on a node of the cluster"),
        ("localhost", "give HOST:PORT"),
        ("user:secret@127.0.0.1:6379", "give HOST:PORT"),
        ("http://127.0.0.1:6379", "give HOST:PORT"),
        ("127.0.0.1:99999", "give HOST:PORT"),
        ("auto", "RAY_ADDRESS is not set"),
        ("no-such-host.invalid:6379", "there is no host"),
    ],
)
def test_what_is_no_address_is_refused(address: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(FleetError, match=said), connected(address):
        pass


def test_a_cluster_that_is_not_there_is_an_error_at_once() -> None:
    with pytest.raises(FleetError, match="no Ray cluster answers"), connected(f"127.0.0.1:{free_port()}"):
        pass


def test_auto_is_the_address_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"127.0.0.1:{free_port()}"
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(FleetError, match=f"answers at {address}"), connected("auto"):
        pass


def test_cpus_of_a_cluster_that_is_there_are_refused() -> None:
    with pytest.raises(FleetError, match="where its nodes start"), connected("127.0.0.1:6379", cpus=2):
        pass


def test_a_cluster_needs_a_cpu() -> None:
    with pytest.raises(FleetError, match="cannot have 0 CPUs"), connected(None, cpus=0):
        pass


def test_a_network_needs_token_and_tls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RAY_AUTH_MODE", "RAY_USE_TLS", *cluster._CERTIFICATES):
        monkeypatch.delenv(name, raising=False)
    file = tmp_path / "file"
    file.write_text("content")
    steps = [
        ("RAY_AUTH_MODE=token is not set", {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}),
        ("RAY_USE_TLS=1 is not set", {"RAY_USE_TLS": "1"}),
        ("RAY_TLS_SERVER_CERT names no file", {"RAY_TLS_SERVER_CERT": str(file), "RAY_TLS_SERVER_KEY": str(file)}),
        ("RAY_TLS_CA_CERT names no file", {"RAY_TLS_CA_CERT": str(file)}),
    ]
    for said, variables in steps:
        with pytest.raises(FleetError, match=said), connected("192.0.2.1:6379"):
            pass
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
    monkeypatch.setattr(cluster, "_CONNECT_TIMEOUT_S", 0.2)
    with pytest.raises(FleetError, match="no Ray cluster answers"), connected("192.0.2.1:6379"):  # nobody has it
        pass


def test_a_trusted_network_is_logged(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    monkeypatch.setattr(cluster, "_CONNECT_TIMEOUT_S", 0.2)
    with pytest.raises(FleetError, match="answers"), connected("192.0.2.1:6379", trusted_network=True):
        pass
    assert "fleet_network_trusted" in caplog.text + capfd.readouterr().err  # a command line has set up events before


def test_a_token_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.delenv("RAY_AUTH_TOKEN", raising=False)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "nothing"))
    with pytest.raises(FleetError, match="nothing: there is no token"), connected("127.0.0.1:6379"):
        pass


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(DependencyError, match=r"semantic-mapper\[fleet\]"), connected(None):
        pass


@pytest.mark.slow
def test_a_silent_server_is_waited_for_a_bounded_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_JOIN_TIMEOUT_S", 8.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(FleetError, match="does not answer within 8 s"), connected(address):
            pass


@pytest.mark.slow
def test_ray_that_listens_beyond_loopback_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    if ray.util.get_node_ip_address().startswith("127."):
        pytest.skip("this machine has no address beyond loopback")
    monkeypatch.setattr(cluster, "_on_loopback", nullcontext)
    before = set(psutil.Process().children(recursive=True))  # other tests' worker pools among them
    with pytest.raises(FleetError, match="beyond this machine, and was ended"), connected(None, cpus=1):
        pass
    assert not ray.is_initialized()
    assert set(psutil.Process().children(recursive=True)) <= before


@pytest.mark.slow
def test_an_embedded_cluster_ends_after_an_error_and_another_one_starts() -> None:
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), connected(None, cpus=1):
            raise ZeroDivisionError
        assert not ray.is_initialized()


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_ends_the_embedded_cluster(signum: signal.Signals) -> None:
    command = [sys.executable, "-c", WAITING]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as program:
        assert program.stdout is not None
        folder = Path(program.stdout.readline().strip())
        assert (folder / "token").is_file()
        children = psutil.Process(program.pid).children(recursive=True)
        assert children
        program.send_signal(signum)
        program.wait(timeout=60)
    _, alive = psutil.wait_procs(children, timeout=120)
    assert alive == []
    if signum != signal.SIGKILL:  # what it leaves then is the folder, which only this user can read
        assert not folder.exists()


@pytest.mark.slow
def test_an_interrupted_start_leaves_no_process() -> None:
    before = set(Path("/tmp").glob("sm-ray-*"))
    with subprocess.Popen([sys.executable, "-c", WAITING], stderr=subprocess.DEVNULL) as program:
        while not [p for p in psutil.Process(program.pid).children() if p.name() == "gcs_server"]:
            assert program.poll() is None
            time.sleep(0.05)
        children = psutil.Process(program.pid).children(recursive=True)
        program.send_signal(signal.SIGINT)
        program.wait(timeout=60)
    _, alive = psutil.wait_procs(children, timeout=60)
    assert alive == []
    assert set(Path("/tmp").glob("sm-ray-*")) <= before


@pytest.mark.slow
def test_a_cluster_is_joined_and_left(nodes: RayNodes, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in nodes.environment.items():
        monkeypatch.setenv(name, value)
    for _ in range(2):
        with connected(nodes.address) as joined:
            assert not joined.embedded
            assert not joined.trusted_network
            assert (joined.address, joined.nodes, joined.cpus) == (nodes.address, 2, 1.0)
            assert ray.get(ray.remote(process_id).remote()) != os.getpid()
    assert beyond_loopback(nodes.processes()) == []
    assert len([p for p in nodes.processes() if p.name() == "raylet"]) == 2


@pytest.mark.slow
def test_without_the_token_a_cluster_cannot_be_joined(nodes: RayNodes) -> None:
    assert "asks for another token" in join(nodes.address)
    assert "asks for another token" in join(nodes.address, RAY_AUTH_MODE="token", RAY_AUTH_TOKEN="0" * 64)
    assert "joined 2" in join(nodes.address, **nodes.environment)


@pytest.mark.slow
def test_an_embedded_cluster_asks_for_its_token() -> None:
    with connected(None, cpus=1) as joined:
        assert "asks for another token" in join(joined.address)
