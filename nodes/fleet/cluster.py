"""The Ray cluster that a fleet runs on: one of its own on this machine, or one that is there already.

A cluster of its own listens on loopback only, and asks every client for a token that only this user can read. A cluster
that is reached through a network must ask for a token and encrypt, unless the user says that the network is safe.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil

from semantic_mapper.errors import DependencyError, FleetError
from semantic_mapper.log_events import get_logger

LOCAL = "local"
_AUTO = "auto"
_CLIENT_SCHEME = "ray://"
_CONNECT_TIMEOUT_S = 5.0
_JOIN_TIMEOUT_S = 40.0
_EMBEDDED_TRIES = 4
_END_TIMEOUT_S = 10.0
# The fleet's tasks read and write files, and pass small values. Ray takes at least 75 MiB, and falls back to files in
# its folder where /dev/shm is smaller, as in containers.
_OBJECT_STORE_FRACTION = 0.1
_OBJECT_STORE_MIN, _OBJECT_STORE_MAX = 80 << 20, 512 << 20
_LONGEST_TEMPORARY = 30  # letters: below it Ray puts sockets, whose paths may be 107 bytes long
_LONGEST_REASON = 400  # letters
_CERTIFICATES = ("RAY_TLS_SERVER_CERT", "RAY_TLS_SERVER_KEY", "RAY_TLS_CA_CERT")
_COMMON = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run` Ray would send the working folder to every node
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "1",  # tasks that declare no GPU see none
}
# By default a node gives up after 30 s, and after 15 s without its agent: too soon on a machine that has other work.
_PATIENT = {"RAY_raylet_start_wait_time_s": "90", "RAY_agent_register_timeout_ms": "60000"}
_HOW_TO_SECURE = (
    "start every node with RAY_AUTH_MODE=token, RAY_AUTH_TOKEN_PATH, RAY_USE_TLS=1, RAY_TLS_SERVER_CERT, "
    "RAY_TLS_SERVER_KEY and RAY_TLS_CA_CERT in its environment, and set the same ones here (docs/fleet-cluster.md has "
    "the commands); or give --trusted-network where nobody else can reach the cluster's network"
)

# Joins as this process is going to. Where something is wrong, Ray waits for minutes, and some faults abort the process.
_PROBE = """
import sys
import ray
from ray._private import ray_constants
ray_constants.ENABLE_RAY_CLUSTER = ray_constants.ENABLE_RAY_CLUSTER and sys.argv[2] != "loopback"
ray.init(address=sys.argv[1], logging_level="ERROR", log_to_driver=False)
"""

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Cluster:
    """What a fleet has to work with, as it was when it was joined.

    Attributes:
        address: ``HOST:PORT`` of its head.
        nodes: That live.
        cpus: Of all nodes, as they were declared.
        gpus: Likewise.
        memory_bytes: That tasks may declare, of all nodes.
        embedded: Started by this process, and ends with it.
        trusted_network: Reached through a network without token or TLS, because the user says that it is safe.
    """

    address: str
    nodes: int
    cpus: float
    gpus: float
    memory_bytes: int
    embedded: bool
    trusted_network: bool = False


@contextlib.contextmanager
def connected(
    address: str | None,
    *,
    cpus: int | None = None,
    trusted_network: bool = False,
    worker_logs: bool = False,
) -> Iterator[Cluster]:
    """Connect this process to a Ray cluster, for the length of the context.

    Args:
        address: None or ``local`` starts a cluster in this machine that ends with the context. ``HOST:PORT`` joins one
            that is there; a node of it must run on this machine. ``auto`` joins the one that the variable
            ``RAY_ADDRESS`` names.
        cpus: Of the embedded cluster; None = all that this process may use.
        trusted_network: Join a cluster beyond this machine even where it has no token or no TLS.
        worker_logs: Show on stderr what tasks print.

    Raises:
        DependencyError: The extra ``fleet`` is not installed.
        FleetError: The cluster cannot be started, is not there, is not safe, or runs another version of Ray or Python.
    """
    ray = _import_ray()
    if ray.is_initialized():
        raise FleetError("this process is connected to a Ray cluster already; leave it first (ray.shutdown())")
    if address is None or address == LOCAL:
        if cpus is not None and cpus < 1:
            raise FleetError(f"a cluster cannot have {cpus} CPUs; give 1 or more")
        with _embedded(ray, cpus, worker_logs=worker_logs) as cluster:
            yield cluster
        return
    if cpus is not None:
        raise FleetError(
            f"the CPUs of the cluster at {address} are declared where its nodes start; leave them out here"
        )
    with _joined(ray, _named(address), trusted_network=trusted_network, worker_logs=worker_logs) as cluster:
        yield cluster


def _import_ray() -> Any:
    try:
        import ray
    except ModuleNotFoundError as error:
        raise DependencyError(
            f'the fleet needs the package ray ({error}): pip install "semantic-mapper[fleet]"'
        ) from error
    return ray


@contextlib.contextmanager
def _embedded(ray: Any, cpus: int | None, *, worker_logs: bool) -> Iterator[Cluster]:
    with contextlib.ExitStack() as end:
        folder = Path(tempfile.mkdtemp(prefix="sm-ray-", dir=_short_temporary_folder()))  # mode 0700
        end.callback(shutil.rmtree, folder, ignore_errors=True)
        token = folder / "token"
        with open(os.open(token, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(secrets.token_hex(32))
        # A path, because programs that report errors often send the environment with them.
        variables = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), "RAY_USE_TLS": "0"}
        end.enter_context(_environment({**_COMMON, **_PATIENT, **variables}, without=("RAY_AUTH_TOKEN",)))
        end.enter_context(_on_loopback())
        end.callback(_end, ray, token)
        _init(
            ray,
            "the embedded Ray cluster",
            tries=_EMBEDDED_TRIES,
            address=LOCAL,
            num_cpus=cpus if cpus is not None else len(os.sched_getaffinity(0)),
            include_dashboard=False,
            object_store_memory=_object_store_bytes(),
            log_to_driver=worker_logs,
            _temp_dir=str(folder / "ray"),  # Ray lets everybody write here; nobody else comes through the one above
        )
        _refuse_open_ports(token)
        cluster = _described(ray, embedded=True)
        _log.info("ray_started", address=cluster.address, cpus=cluster.cpus, gpus=cluster.gpus)
        yield cluster


@contextlib.contextmanager
def _joined(ray: Any, address: str, *, trusted_network: bool, worker_logs: bool) -> Iterator[Cluster]:
    is_near = _is_loopback(address)
    if not is_near:
        _require_security(address, trusted_network=trusted_network)
    _check_token_files()
    _check_answers(address)
    with contextlib.ExitStack() as end:
        end.enter_context(_environment(_COMMON))
        if is_near:
            end.enter_context(_on_loopback())
        _probe(address, is_near=is_near)
        end.callback(ray.shutdown)
        _init(ray, f"the Ray cluster at {address}", address=address, log_to_driver=worker_logs)
        cluster = _described(ray, embedded=False)
        far = sorted({node["NodeManagerAddress"] for node in _living(ray)} - {"127.0.0.1", "::1"})
        if is_near and far:  # a cluster of many machines answers on its head's loopback, too
            _require_security(far[0], trusted_network=trusted_network)
        is_trusted = bool(far) and _missing_security() is not None
        yield replace(cluster, trusted_network=is_trusted)


def _init(ray: Any, what: str, tries: int = 1, **arguments: Any) -> None:
    """``ray.init``, with its many errors as one, and without its handler of SIGTERM where the program has its own.

    Ray gives a node 30 s to start, which are too few where much else runs: it is started up to ``tries`` times.
    """
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        while not _started(ray, arguments, is_last=tries <= 1):
            tries -= 1
    except (ConnectionError, OSError, RuntimeError, TimeoutError, ValueError, ray.exceptions.RayError) as error:
        raise FleetError(f"{what} cannot be used: {_reason(str(error)) or type(error).__name__}") from error
    finally:
        if is_main and handler not in (signal.SIG_DFL, None):
            signal.signal(signal.SIGTERM, handler)


def _started(ray: Any, arguments: Mapping[str, Any], *, is_last: bool) -> bool:
    """Whether Ray has started in time.

    Raises:
        RuntimeError: It has not, and this was the last try.
    """
    try:
        ray.init(configure_logging=True, logging_level=logging.ERROR, **arguments)
    except Exception as error:  # Ray raises this very class for a node that is late
        if "timed out during startup" not in str(error):
            raise
        ray.shutdown()
        if is_last:
            raise RuntimeError("it did not start in time; the machine may have too much else to do") from error
        _log.warning("ray_slow_to_start")
        return False
    return True


def _probe(address: str, *, is_near: bool) -> None:
    """Join the cluster in another process, within a bounded time.

    Raises:
        FleetError: With what Ray said.
    """
    command = [sys.executable, "-c", _PROBE, address, "loopback" if is_near else "network"]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=_JOIN_TIMEOUT_S
        )
    except subprocess.TimeoutExpired as error:
        said = error.stderr.decode(errors="replace") if isinstance(error.stderr, bytes) else error.stderr or ""
        is_late = True
    else:
        if done.returncode == 0:
            return
        said, is_late = done.stderr, False
    what = f"the Ray cluster at {address}"
    if "InvalidAuthToken" in said or "AuthenticationError" in said:
        raise FleetError(
            f"{what} asks for another token: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN_PATH to the file of its token "
            "(by itself `ray start` takes ~/.ray/auth_token, where there is one)"
        )
    if "Version mismatch" in said:
        raise FleetError(f"{what} runs another version: {_reason(said[said.index('Version mismatch') :])}")
    if is_late:
        raise FleetError(
            f"{what} does not answer within {_JOIN_TIMEOUT_S:g} s: it is no Ray cluster, it has stalled, or only one "
            f"side uses TLS (RAY_USE_TLS is '{os.environ.get('RAY_USE_TLS', '0')}' here)"
        )
    if "No node info found" in said:
        raise FleetError(
            f"{what} has no node on this machine: run `ray start --address={address} --num-cpus=0` here first, with "
            "the same token and certificates"
        )
    raise FleetError(f"{what} cannot be used: {_reason(said[-_LONGEST_REASON:])}")


def _reason(text: str) -> str:
    """One line of what Ray says on a page."""
    return " ".join(text.split())[:_LONGEST_REASON]


def _described(ray: Any, *, embedded: bool) -> Cluster:
    resources = ray.cluster_resources()
    return Cluster(
        address=ray.get_runtime_context().gcs_address,
        nodes=len(_living(ray)),
        cpus=resources.get("CPU", 0.0),
        gpus=resources.get("GPU", 0.0),
        memory_bytes=int(resources.get("memory", 0)),
        embedded=embedded,
    )


def _living(ray: Any) -> list[dict[str, Any]]:
    return [node for node in ray.nodes() if node["Alive"]]


@contextlib.contextmanager
def _environment(variables: Mapping[str, str], *, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Environment variables for Ray and the processes it starts; afterwards everything is as before."""
    names = (*variables, *without)
    before = {name: os.environ.get(name) for name in names}
    for name in without:
        os.environ.pop(name, None)
    os.environ.update(variables)
    _reread_environment()
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        _reread_environment()


def _reread_environment() -> None:
    """Ray's core reads token and mode once in a process, which may have been in another cluster before."""
    from ray import _raylet

    core: Any = _raylet  # compiled, without stubs
    core.Config.initialize("")
    core.AuthenticationTokenLoader.instance().reset_cache()


@contextlib.contextmanager
def _on_loopback() -> Iterator[None]:
    """Let Ray take 127.0.0.1 for this machine's address, as it does on Windows and macOS.

    It replaces 127.0.0.1 by the machine's own address otherwise, and then its servers listen on every address.
    """
    from ray._private import ray_constants

    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def _short_temporary_folder() -> str:
    folder = tempfile.gettempdir()
    return folder if len(folder) <= _LONGEST_TEMPORARY else "/tmp"


def _object_store_bytes() -> int:
    fraction = int(psutil.virtual_memory().available * _OBJECT_STORE_FRACTION)
    return min(max(fraction, _OBJECT_STORE_MIN), _OBJECT_STORE_MAX)


def _own_processes(token: Path) -> list[psutil.Process]:
    """Those of the embedded cluster: children that were given its token, and what they have started."""
    found: list[psutil.Process] = []
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.Error):
            if child.environ().get("RAY_AUTH_TOKEN_PATH") == str(token):
                found += [child, *child.children(recursive=True)]
    return found


def _refuse_open_ports(token: Path) -> None:
    for process in _own_processes(token):
        with contextlib.suppress(psutil.NoSuchProcess):
            for connection in process.net_connections(kind="inet"):
                if connection.status == psutil.CONN_LISTEN and not _is_loopback_ip(connection.laddr.ip):
                    raise FleetError(
                        f"Ray's {process.name()} listens on {connection.laddr.ip}:{connection.laddr.port}, beyond this "
                        "machine, and was ended: this release of Ray cannot be kept on loopback; install another one"
                    )


def _end(ray: Any, token: Path) -> None:
    """Shut Ray down. A start that was interrupted leaves processes that Ray has forgotten: they are killed."""
    left = _own_processes(token)
    timeout_s = _END_TIMEOUT_S if ray.is_initialized() else 0.0
    ray.shutdown()
    _, alive = psutil.wait_procs(left, timeout=timeout_s)
    for process in alive:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(alive, timeout=_END_TIMEOUT_S)


def _named(address: str) -> str:
    """The address, as ``HOST:PORT``."""
    if address == _AUTO:
        # Ray would take the newest cluster that a file in /tmp names, which any user of the machine may write.
        address = os.environ.get("RAY_ADDRESS", "")
        if address in ("", _AUTO):
            raise FleetError("--ray auto: RAY_ADDRESS is not set; set it, or give the address as HOST:PORT")
    if address.startswith(_CLIENT_SCHEME):
        raise FleetError(
            f"{address}: Ray Client ends the run when its connection breaks; run this command on a node of the cluster "
            "(ray start --address=HOST:PORT --num-cpus=0 makes this machine one) and give --ray HOST:PORT"
        )
    try:
        host, port = _host_and_port(address)
    except ValueError:
        host, port = "", 0
    if not host or not port or not set(address).isdisjoint("/@?#"):
        raise FleetError(f"'{address}' is not the address of a Ray cluster; give HOST:PORT, local or auto")
    return address


def _host_and_port(address: str) -> tuple[str, int]:
    parts = urlsplit(f"//{address}")
    return parts.hostname or "", parts.port or 0


def _is_loopback(address: str) -> bool:
    host, port = _host_and_port(address)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        raise FleetError(f"{address}: there is no host '{host}' ({error}); name the head of the cluster") from error
    return all(_is_loopback_ip(str(entry[4][0])) for entry in found)


def _is_loopback_ip(text: str) -> bool:
    ip = ipaddress.ip_address(text.partition("%")[0])
    mapped = ip.ipv4_mapped if isinstance(ip, ipaddress.IPv6Address) else None
    return (mapped or ip).is_loopback


def _require_security(address: str, *, trusted_network: bool) -> None:
    missing = _missing_security()
    if missing is None:
        return
    if not trusted_network:
        raise FleetError(f"{address} is reached through a network, and {missing}: {_HOW_TO_SECURE}")
    _log.warning("fleet_network_trusted", address=address, missing=missing)


def _missing_security() -> str | None:
    """What is missing of token authentication and TLS in this environment; None = nothing."""
    if os.environ.get("RAY_AUTH_MODE", "").lower() != "token":
        return "RAY_AUTH_MODE=token is not set, so that anybody there can run code"
    if os.environ.get("RAY_USE_TLS", "0").lower() not in ("1", "true"):
        return "RAY_USE_TLS=1 is not set, so that anybody there can read everything, the token included"
    for name in _CERTIFICATES:
        path = os.environ.get(name)
        if not path or not Path(path).is_file():
            return f"{name} names no file"
    return None


def _check_token_files() -> None:
    """Ray's core aborts the process where the token it was promised is missing."""
    if os.environ.get("RAY_AUTH_MODE", "").lower() != "token" or os.environ.get("RAY_AUTH_TOKEN"):
        return
    named = os.environ.get("RAY_AUTH_TOKEN_PATH")
    path = Path(named) if named else Path.home() / ".ray" / "auth_token"
    try:
        is_there = bool(path.read_text(encoding="utf-8").strip())
    except (OSError, UnicodeDecodeError):
        is_there = False
    if not is_there:
        raise FleetError(f"{path}: there is no token of the cluster; copy it there, or set RAY_AUTH_TOKEN_PATH")


def _check_answers(address: str) -> None:
    """Ray itself waits for minutes for what is not there."""
    try:
        socket.create_connection(_host_and_port(address), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise FleetError(
            f"no Ray cluster answers at {address} ({error}); start its head (ray start --head), or mend the address"
        ) from error
