"""Examinations of a launch file: what `up` or its nodes would refuse, ports that are taken, keys that are of no use."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.doctor.check import Check, failed
from semantic_mapper.nodes.doctor.launch_nodes import node_settings
from semantic_mapper.nodes.launcher.launch_file import Launch, load_launch
from semantic_mapper.nodes.options import FoxgloveOptions, MapperOptions
from semantic_mapper.transport.endpoints import check_bind
from semantic_mapper.transport.keys import load_keys, user_key_folder


def launch_file(path: Path, settings: Sequence[str]) -> Iterator[Check]:
    """Whether it can be started, and where it would listen.

    Args:
        path: Of the file.
        settings: As of ``load_launch``.
    """
    try:
        launch = load_launch(path, settings)
    except SemanticMapperError as error:
        yield failed(path.name, error)
        return
    yield Check(path.name, "ok", f"{len(launch.nodes)} nodes: {', '.join(node.name for node in launch.nodes)}")
    yield from node_settings(launch)
    checks = {keys: keys_in(Path(keys).expanduser()) for _, keys in _listening(launch) if keys}
    yield from checks.values()
    for endpoint, keys in _listening(launch):
        if not keys or checks[keys].state != "bad":  # else it is reported already why nothing can listen there
            yield _address(endpoint, keys)


def own_keys() -> Iterator[Check]:
    """Those of this user, where there are any."""
    folder = user_key_folder()
    if folder.exists():
        yield keys_in(folder)
    else:
        yield Check("keys", "ok", f"none in {folder}; only what other machines are to reach needs them")


def keys_in(folder: Path) -> Check:
    """Whether the keys of a folder, and those of all peers, can be used."""
    try:
        peers = load_keys(folder).peers()
    except SemanticMapperError as error:
        return failed("keys", error)
    if not peers:
        return Check(
            "keys", "note", f"{folder}: no peers, so that nobody is let in", "semantic-mapper keys allow NAME KEY"
        )
    return Check("keys", "ok", f"{folder}: this machine's, and those of {', '.join(peers)}")


def _listening(launch: Launch) -> list[tuple[str, str]]:
    """Addresses that the launch binds outside of its own folder, each with the folder of its keys."""
    found = [(launch.publish, launch.keys)]
    for options in launch.options.values():
        if isinstance(options, MapperOptions):
            found += [(options.query, options.keys), (options.publish, options.keys)]
        elif isinstance(options, FoxgloveOptions):
            found.append((f"tcp://127.0.0.1:{options.port}", ""))
    return [(endpoint, keys) for endpoint, keys in found if "://" in endpoint]


def _address(endpoint: str, folder: str) -> Check:
    try:
        check_bind(endpoint, load_keys(Path(folder).expanduser()) if folder else None)
    except SemanticMapperError as error:
        return failed("address", error)
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    if endpoint.startswith("tcp://") and re.fullmatch("[0-9]{1,5}", port) and _port_is_taken(int(port), host):
        fix = f"`ss -ltnp 'sport = :{port}'` says who; give another with --set"
        return Check("address", "note", f"{endpoint} is in use (by this very launch, if it runs)", fix)
    return Check("address", "ok", endpoint)


def _port_is_taken(port: int, host: str = "127.0.0.1") -> bool:
    """Whether somebody listens at a TCP port of this machine.

    Args:
        port: Its number.
        host: Where one wants to listen; other than on loopback, all interfaces count.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1" if host in ("127.0.0.1", "localhost") else "", port))
        except OSError:
            return True
    return False
