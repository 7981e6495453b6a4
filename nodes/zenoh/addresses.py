"""Where Zenoh may listen and connect: on this machine freely, beyond it with certificates on both sides."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from semantic_mapper.errors import ConfigError, TransportError
from semantic_mapper.nodes.options import ZenohOptions
from semantic_mapper.transport.endpoints import is_loopback

AUTHORITY, CERTIFICATE, KEY = "ca.pem", "own.pem", "own.key"  # in the folder of certificates
MAX_PORT = 65535
_ADDRESS = re.compile(r"(tcp|tls)/((?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+):\d{1,5})")


def zenoh_settings(options: ZenohOptions) -> dict[str, Any]:
    """Zenoh's configuration: it listens and connects where it is instructed to, and looks for nobody.

    Raises:
        ConfigError: an invalid address.
        TransportError: other machines could connect, or are connected to, without certificates; or these are not there.
    """
    folder = Path(options.certificates).expanduser() if options.certificates else None
    for address in (options.listen, options.connect):
        if address:
            _check(address, folder)
    used = [address for address in (options.listen, options.connect) if address]
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [options.listen] if options.listen else [],
        "connect/endpoints": [options.connect] if options.connect else [],
        "connect/timeout_ms": -1,  # a router that is not there yet is tried again ...
        "connect/exit_on_failure": False,  # ... meanwhile everybody else is served
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/protocols": sorted({address.partition("/")[0] for address in used}),
        "transport/shared_memory/enabled": False,  # what is killed would leave some behind
        "transport/link/rx/max_message_size": 1 << 20,  # clients send nothing but subscriptions and questions
    }
    if folder is not None:
        settings |= _tls(folder)
    return settings


def _check(address: str, folder: Path | None) -> None:
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise ConfigError(
            f"'{address}' is no address of Zenoh that is taken here; write tcp/127.0.0.1:PORT, or with certificates "
            "tls/ADDRESS:PORT"
        )
    port = found[2].rpartition(":")[2].lstrip("0")
    if len(port) > len(str(MAX_PORT)) or int(port or 0) > MAX_PORT:
        raise ConfigError(f"'{address:.80}': ports end at {MAX_PORT}")
    if found[1] == "tcp" and not is_loopback(found[2]):
        raise TransportError(
            f"{address}: other machines would be at the other end, which needs certificates on both sides: give "
            f"tls/{found[2]}, and a folder with {AUTHORITY}, {CERTIFICATE} and {KEY} as `certificates`; without them "
            "use tcp/127.0.0.1:PORT, and tunnel it (ssh -L) from elsewhere"
        )
    if found[1] == "tls" and folder is None:
        raise TransportError(
            f"{address}: needs a folder with {AUTHORITY}, {CERTIFICATE} and {KEY} as `certificates`; see "
            "docs/howto.md for how to make them"
        )


def _tls(folder: Path) -> dict[str, Any]:
    for name in (AUTHORITY, CERTIFICATE, KEY):
        if not (folder / name).is_file():
            raise TransportError(f"{folder / name}: no such file; docs/howto.md says how to make certificates")
    key = folder / KEY
    if key.stat().st_mode & 0o077:
        raise TransportError(f"{key}: others can read the secret key; `chmod 600 {key}`, or make a new one")
    tls: dict[str, Any] = {"root_ca_certificate": str(folder / AUTHORITY), "enable_mtls": True}
    tls |= {"listen_certificate": str(folder / CERTIFICATE), "listen_private_key": str(key)}
    tls |= {"connect_certificate": str(folder / CERTIFICATE), "connect_private_key": str(key)}
    tls["verify_name_on_connect"] = True
    return {f"transport/link/tls/{name}": value for name, value in tls.items()}
