"""The Ray cluster that a fleet runs on: one of its own on this machine, or one that runs already.

A cluster of its own listens on loopback only, and every client needs a token that only this user can read. A cluster
that is reached through a network must need a token, too.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import secrets
import signal
import socket
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from semantic_mapper.errors import DependencyError, FleetError

_CONNECT_TIMEOUT_S = 5.0
_OBJECT_STORE_BYTES = 256 << 20  # tasks read and write files, and pass small values
_COMMON = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run` Ray would send the working folder to every node
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "1",  # tasks that declare no GPU see none
}
# By default a node gives up after 30 s, and after 15 s without its agent: too soon on a machine that has other work.
_PATIENT = {"RAY_raylet_start_wait_time_s": "240", "RAY_agent_register_timeout_ms": "120000"}


@contextlib.contextmanager
def connected(address: str | None, *, cpus: int | None = None, worker_logs: bool = False) -> Iterator[None]:
    """Connect this process to a Ray cluster, for the length of the context.

    Args:
        address: None starts a cluster on this machine that ends with the context. ``HOST:PORT`` joins one that runs; a
            node of it must run on this machine (``ray start --address=HOST:PORT --num-cpus=0``).
        cpus: Of the cluster of this machine; None = all that this process may use.
        worker_logs: Show on stderr what tasks print.

    Raises:
        DependencyError: the extra ``fleet`` is not installed.
        FleetError: the cluster cannot be started, is not there, or is not safe.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise DependencyError(
            f'the fleet needs the package ray ({error}): pip install "semantic-mapper[fleet]"'
        ) from error
    with contextlib.ExitStack() as stack:
        if address is None:
            # Not where TMPDIR says: Ray puts sockets there, whose paths may be 107 bytes long.
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sm-ray-", dir="/tmp")))
            token = folder / "token"
            token.touch(0o600)
            token.write_text(secrets.token_hex(32), encoding="ascii")
            # A path, because programs that report errors often send the environment with them.
            security = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), "RAY_USE_TLS": "0"}
            stack.enter_context(_environment({**_COMMON, **_PATIENT, **security}))
            stack.enter_context(_on_loopback())
            found = {
                "address": "local",
                "num_cpus": cpus or len(os.sched_getaffinity(0)),
                "include_dashboard": False,
                "object_store_memory": _OBJECT_STORE_BYTES,
                "_temp_dir": str(folder / "ray"),  # open to everybody; nobody else comes through the folder above
            }
        else:
            _check_reachable(address)
            stack.enter_context(_environment(_COMMON))
            if _is_loopback(address):
                stack.enter_context(_on_loopback())
            found = {"address": address}
        stack.callback(ray.shutdown)
        _start(ray, {**found, "log_to_driver": worker_logs})
        yield


def _start(ray: Any, arguments: Mapping[str, Any]) -> None:
    """``ray.init``, with its many errors as one, and without its handler of SIGTERM where the program has its own."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(logging_level=logging.ERROR, **arguments)
    except Exception as error:  # Ray raises this very class for a node that is late
        reason = " ".join(str(error).split())[:400] or type(error).__name__
        raise FleetError(f"the Ray cluster at '{arguments['address']}' cannot be used: {reason}") from error
    finally:
        if handler not in (signal.SIG_DFL, None):
            signal.signal(signal.SIGTERM, handler)


def _check_reachable(address: str) -> None:
    """Ray waits for minutes for what is not there, and its core aborts the process where a token is missing.

    Raises:
        FleetError: no address, nobody there, or no token where one is needed.
    """
    parts = urlsplit(f"//{address}")
    try:
        host, port = parts.hostname or "", parts.port or 0
    except ValueError:
        host, port = "", 0
    if not host or not port or parts.netloc != address or "@" in address:
        raise FleetError(f"'{address}' is not the address of a Ray cluster; give HOST:PORT")
    has_token = os.environ.get("RAY_AUTH_MODE", "").lower() == "token"
    if has_token and not os.environ.get("RAY_AUTH_TOKEN"):
        path = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
        if not path.is_file() or not path.stat().st_size:
            raise FleetError(f"{path}: there is no token of the cluster; copy it there, or set RAY_AUTH_TOKEN_PATH")
    if not has_token and not _is_loopback(address):
        raise FleetError(
            f"{address} is reached through a network, and RAY_AUTH_MODE=token is not set, so that anybody there can "
            "run code; start every node with RAY_AUTH_MODE=token and RAY_AUTH_TOKEN_PATH, and set both here, too"
        )
    try:
        socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError as error:
        raise FleetError(
            f"no Ray cluster answers at {address} ({error}); start its head (ray start --head), or correct the address"
        ) from error


def _is_loopback(address: str) -> bool:
    host = urlsplit(f"//{address}").hostname or ""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError as error:
        raise FleetError(f"{address}: there is no host '{host}' ({error}); name the head of the cluster") from error
    return all(ipaddress.ip_address(str(entry[4][0]).partition("%")[0]).is_loopback for entry in found)


@contextlib.contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Environment variables for Ray and the processes it starts; afterwards everything is as before."""
    before = dict(os.environ)
    os.environ.update(variables)
    if "RAY_AUTH_TOKEN_PATH" in variables:
        os.environ.pop("RAY_AUTH_TOKEN", None)  # it would go before the path
    _reread_environment()
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
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
