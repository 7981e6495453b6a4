"""The Ray cluster that a fleet runs on: one of its own on this machine, or one that runs already.

A cluster of its own listens on loopback only, and every client needs a token that only this user can read. A cluster
that is reached through a network must need a token, too.
"""

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

from semantic_mapper.errors import FleetError
from semantic_mapper.nodes.fleet.store import fleet_package

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

    Raises DependencyError: the extra ``fleet`` is not installed. FleetError: the cluster cannot be started, is not
    there, or is not safe.

    Args:
        address: None starts a cluster on this machine that ends with the context. ``HOST:PORT`` joins one that runs; a
            node of it must run on this machine (``ray start --address=HOST:PORT --num-cpus=0``).
        cpus: Of the cluster of this machine; None = all that this process may use.
        worker_logs: Show on stderr what tasks print.
    """
    ray = fleet_package("ray")
    is_local = address is None or _check_address(address)
    with contextlib.ExitStack() as stack:
        variables = _COMMON
        arguments: dict[str, Any] = {"address": address}
        if address is None:
            # Not where TMPDIR says: Ray puts sockets there, whose paths may be 107 bytes long.
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sm-ray-", dir="/tmp")))
            token = folder / "token"
            token.touch(0o600)
            token.write_text(secrets.token_hex(32), encoding="ascii")
            # A path, because programs that report errors often send the environment with them.
            security = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token), "RAY_USE_TLS": "0"}
            variables = {**_COMMON, **_PATIENT, **security}
            arguments = {
                "address": "local",
                "num_cpus": cpus or len(os.sched_getaffinity(0)),
                "include_dashboard": False,
                "object_store_memory": _OBJECT_STORE_BYTES,
                "_temp_dir": str(folder / "ray"),  # open to everybody; nobody else comes through the folder above
            }
        stack.enter_context(_settings_of_ray(variables, is_local=is_local))
        stack.callback(ray.shutdown)
        handler = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(logging_level=logging.ERROR, log_to_driver=worker_logs, **arguments)
        except Exception as error:  # Ray raises this very class for a node that is late
            reason = " ".join(str(error).split())[:400] or type(error).__name__
            raise FleetError(f"the Ray cluster at '{arguments['address']}' cannot be used: {reason}") from error
        finally:
            if handler not in (signal.SIG_DFL, None):  # Ray puts its own there
                signal.signal(signal.SIGTERM, handler)
        yield


def _check_address(address: str) -> bool:
    """Whether the cluster is on this machine. Ray waits for minutes for what is not there, and its core aborts the
    process where a token is missing: ``FleetError`` for these, and for a network without tokens."""
    parts = urlsplit(f"//{address}")
    try:
        host, port = parts.hostname or "", parts.port or 0
        if not host or not port or parts.netloc != address or "@" in address:
            raise ValueError("not HOST:PORT")
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (ValueError, OSError) as error:
        raise FleetError(f"'{address}' is not the address of a Ray cluster, HOST:PORT ({error})") from error
    is_local = all(ipaddress.ip_address(str(entry[4][0]).partition("%")[0]).is_loopback for entry in found)
    has_token = os.environ.get("RAY_AUTH_MODE", "").lower() == "token"
    if has_token and not os.environ.get("RAY_AUTH_TOKEN"):
        path = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
        if not path.is_file() or not path.stat().st_size:
            raise FleetError(f"{path}: there is no token of the cluster; copy it there, or set RAY_AUTH_TOKEN_PATH")
    if not has_token and not is_local:
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
    return is_local


@contextlib.contextmanager
def _settings_of_ray(variables: Mapping[str, str], *, is_local: bool) -> Iterator[None]:
    """What Ray and the processes that it starts go by; afterwards everything is as before.

    Ray replaces 127.0.0.1 by the machine's own address, and then its servers listen on every address; where it is to
    stay ``is_local``, Ray takes 127.0.0.1 for this machine's address, as it does on Windows and macOS.
    """
    from ray import _raylet
    from ray._private import ray_constants

    core: Any = _raylet  # compiled, without stubs

    def read_again() -> None:  # token and mode, which Ray's core reads once in a process
        core.Config.initialize("")
        core.AuthenticationTokenLoader.instance().reset_cache()

    before, enabled = dict(os.environ), ray_constants.ENABLE_RAY_CLUSTER
    os.environ.update(variables)
    if "RAY_AUTH_TOKEN_PATH" in variables:
        os.environ.pop("RAY_AUTH_TOKEN", None)  # it would go before the path
    read_again()
    ray_constants.ENABLE_RAY_CLUSTER = enabled and not is_local
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = enabled
        os.environ.clear()
        os.environ.update(before)
        read_again()
