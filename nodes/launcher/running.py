"""Launches of this user that run on this machine: what each of them is, and where its sockets are.

A launch leaves a note in its socket folder: for logs that keep it, and for those who join it from outside.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from semantic_mapper.config import MAX_FILE_BYTES
from semantic_mapper.errors import TransportError
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.nodes.launcher.launch_file import STATUS_SOCKET, Launch
from semantic_mapper.nodes.process_folder import is_in_use, own_folders
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import NewestSubscriber

NOTE = "launch.json"
START_S = 180.0  # how long nodes may take to start
LISTEN_S = 0.5
LIVE = "live"  # on the command line: the mapper of the one launch that runs here
QUERY_SOCKET = "query"  # where a mapper answers unless its launch file says otherwise


class NodeNote(msgspec.Struct, frozen=True):
    """One node, with all its options."""

    name: str
    kind: str
    options: dict[str, Any]


class LaunchNote(msgspec.Struct, frozen=True):
    """The nodes of a launch, in the order of its file."""

    launch: str  # name of the file
    nodes: tuple[NodeNote, ...]

    def names(self, kind: str) -> tuple[str, ...]:
        """Nodes of a kind."""
        return tuple(node.name for node in self.nodes if node.kind == kind)


def leave_launch_note(launch: Launch, folder: Path) -> None:
    """Write the note of a launch into its folder.

    Raises:
        OSError: it cannot be written.
    """
    nodes = tuple(
        NodeNote(n.name, n.kind, _without_passwords(msgspec.to_builtins(launch.options[n.name]))) for n in launch.nodes
    )
    text = msgspec.json.format(msgspec.json.encode(LaunchNote(launch.name, nodes)), indent=1)
    write_bytes(folder / NOTE, text, sync="none")


def _without_passwords(value: Any) -> Any:
    """Options as they may stand in every recording."""
    if isinstance(value, dict):
        return {key: _without_passwords(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_without_passwords(inner) for inner in value]
    return without_secrets(value) if isinstance(value, str) else value


def read_launch_note(folder: Path) -> LaunchNote:
    """Of a launch that runs.

    Raises:
        TransportError: there is no launch, or it cannot be understood.
    """
    try:
        return msgspec.json.decode(read_regular(folder / NOTE, MAX_FILE_BYTES), type=LaunchNote)
    except OSError as error:
        raise TransportError(
            f"{folder}: no socket folder of a launch ({error.strerror}); `up` names its own"
        ) from error
    except msgspec.DecodeError as error:
        raise TransportError(f"{folder / NOTE}: {error}; does another version of the package run there?") from error


def running_launches() -> list[Path]:
    """Socket folders of the launches that run, the newest first."""
    found: list[tuple[int, Path]] = []
    for folder in own_folders():
        try:
            stat = folder.stat()
            if stat.st_uid == os.getuid() and is_in_use(folder) and (folder / STATUS_SOCKET).exists():
                found.append((stat.st_ctime_ns, folder))
        except OSError:  # it has just ended, or is another user's
            continue
    return [folder for _, folder in sorted(found, reverse=True)]


def launch_folder(place: str) -> Path:
    """The socket folder of a running launch.

    Args:
        place: The folder itself; empty = that of the one launch that runs.

    Raises:
        TransportError: none runs, several do, or the folder is not that of a launch.
    """
    if place:
        if not Path(place).exists():
            raise TransportError(f"{place}: no such folder; `up` names the socket folder of its launch as it starts")
        if not (Path(place) / STATUS_SOCKET).exists():
            raise TransportError(f"{place}: no socket folder of a launch that runs; `up` names its own as it starts")
        return Path(place).absolute()
    folders = running_launches()
    if not folders:
        raise TransportError("no launch runs here; `semantic-mapper up LAUNCH.toml` starts one")
    if len(folders) > 1:
        raise TransportError(f"several launches run here; name one by its folder: {', '.join(map(str, folders))}")
    return folders[0]


def refuse_missing_socket(endpoint: str) -> None:
    """Say at once that nobody answers, rather than after several attempts, where there is not even a socket's file.

    Raises:
        TransportError: an ``ipc://`` path without a file.
    """
    transport, _, path = endpoint.partition("://")
    if transport == "ipc" and path and not path.startswith("@") and not Path(path).exists():
        raise TransportError(
            f"{endpoint}: there is no such socket; does the mapper run? `up` names the socket folder of its launch as "
            "it starts, and its mapper answers at ipc://FOLDER/query"
        )


def map_endpoint(place: str) -> str:
    """Where the mapper answers that a person means by a place; empty for anything else, such as a saved map.

    Args:
        place: An endpoint, ``live`` for the one launch that runs, or the socket folder of a launch.

    Raises:
        TransportError: there is no such socket, no launch runs, or several do.
    """
    if place == LIVE:
        place = f"ipc://{launch_folder('')}/{QUERY_SOCKET}"
    elif (Path(place) / STATUS_SOCKET).exists():
        place = f"ipc://{Path(place).absolute()}/{QUERY_SOCKET}"
    if "://" not in place:
        return ""
    refuse_missing_socket(place)
    return place


def node_endpoints(folder: Path) -> dict[str, str]:
    """Where the nodes of a running launch publish, as soon as all of them have said that they run.

    Args:
        folder: Of the launch, from ``launch_folder``.

    Returns:
        By the name of each node that has not ended.

    Raises:
        TransportError: the launcher says nothing, or not all nodes have come to run in time.
    """
    known: dict[str, Status] = {}
    deadline = time.monotonic() + START_S
    status = f"ipc://{folder}/{STATUS_SOCKET}"
    with NewestSubscriber(status, ("status",)) as subscriber:
        while not _all_ready(known):
            message = subscriber.receive(LISTEN_S)
            if isinstance(message, Status):
                known[message.node] = message
            if time.monotonic() > deadline:
                raise TransportError(
                    f"{status}: its nodes have not all come to run for {START_S:g} s; see `view --status`"
                )
    return {
        name: f"ipc://{folder}/{name}"
        for name, node in sorted(known.items())
        if node.state != "ended" and name != STATUS_SOCKET
    }


def _all_ready(known: Mapping[str, Status]) -> bool:
    launch = known.get(STATUS_SOCKET)
    if launch is None or len(known) - 1 < launch.counters["nodes"]:
        return False
    return all(status.state != "starting" for status in known.values())


def status_endpoint(place: str) -> str:
    """Where the launcher of a running launch publishes how it goes.

    Args:
        place: An endpoint, or a socket folder; empty = that of the one launch that runs.

    Raises:
        TransportError: none runs, several do, or the folder is not that of a launch.
    """
    return place if "://" in place else f"ipc://{launch_folder(place)}/{STATUS_SOCKET}"
