"""Ray clusters: one of this machine is on loopback with a token, others need one."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from semantic_mapper.errors import FleetError
from semantic_mapper.nodes.fleet.cluster import connected

ray = pytest.importorskip("ray")

# Prints the folder of a cluster, and waits inside it.
WAITING = """
import os, signal, time
from pathlib import Path
from semantic_mapper.nodes.fleet.cluster import connected
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
with connected(None, cpus=1):
    print(Path(os.environ["RAY_AUTH_TOKEN_PATH"]).parent, flush=True)
    time.sleep(300)
"""
JOINING = """
import sys
import ray
from semantic_mapper.nodes.fleet.cluster import connected
with connected(sys.argv[1]):
    print("joined", len(ray.nodes()))
"""


def environment_of_ray() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith("RAY_") and "CLIENT_MODE" not in name}


@pytest.mark.slow
def test_a_cluster_of_this_machine_is_on_loopback_only_needs_its_token_and_leaves_nothing() -> None:
    before = environment_of_ray()
    others = psutil.Process().children(recursive=True)  # such as the resource tracker of multiprocessing
    with connected(None, cpus=1):
        worker = ray.get(ray.remote(lambda: os.getpid()).remote())
        started = [child for child in psutil.Process().children(recursive=True) if child not in others]
        assert worker != os.getpid() and worker in {process.pid for process in started}
        for process in (psutil.Process(), *started):
            for connection in process.net_connections(kind="inet"):
                if connection.status == psutil.CONN_LISTEN:
                    assert connection.laddr.ip.removeprefix("::ffff:") in ("127.0.0.1", "::1"), process.name()
        token = Path(os.environ["RAY_AUTH_TOKEN_PATH"])
        assert token.stat().st_mode & 0o777 == 0o600 and token.parent.stat().st_mode & 0o777 == 0o700
        assert token.read_text() not in " ".join(" ".join(process.cmdline()) for process in started)
        address = ray.get_runtime_context().gcs_address
        command = [sys.executable, "-c", JOINING, address]
        with_token = subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)
        assert "joined 1" in with_token.stdout, with_token.stderr
        bare = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        without = subprocess.run(command, env=bare, capture_output=True, text=True, timeout=150, check=False)
        assert without.returncode and "joined" not in without.stdout
        assert "auth" in without.stderr.lower()
    assert not ray.is_initialized() and not token.parent.exists() and environment_of_ray() == before
    assert not [process for process in started if process.is_running() and process.status() != "zombie"]


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGKILL])
def test_a_signal_ends_the_cluster_of_this_machine(signum: signal.Signals) -> None:
    command = [sys.executable, "-c", WAITING]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as program:
        folder = Path(program.stdout.readline().strip())
        children = psutil.Process(program.pid).children(recursive=True)
        assert (folder / "token").is_file() and children
        program.send_signal(signum)
        program.wait(timeout=60)
    _, alive = psutil.wait_procs(children, timeout=120)
    assert alive == []
    if signum != signal.SIGKILL:  # what it leaves then is the folder, which only this user can read
        assert not folder.exists()


def test_what_is_no_safe_address_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    monkeypatch.delenv("RAY_AUTH_TOKEN", raising=False)
    for address, said in (
        ("localhost", "not the address of a Ray cluster"),
        ("ray://10.0.0.1:10001", "not the address of a Ray cluster"),
        ("127.0.0.1:99999", "not the address of a Ray cluster"),
        ("no-such-host.invalid:6379", "not the address of a Ray cluster"),
        ("192.0.2.1:6379", "RAY_AUTH_MODE=token is not set, so that anybody there can run code"),
        (f"127.0.0.1:{port}", "no Ray cluster answers"),
    ):
        with pytest.raises(FleetError, match=said), connected(address):
            pass
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "nothing"))
    with pytest.raises(FleetError, match="nothing: there is no token"), connected("127.0.0.1:6379"):
        pass
