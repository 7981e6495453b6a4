"""Finding the launches of this user that run on this machine, by their socket folders."""

from __future__ import annotations

import os
import time
from pathlib import Path

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.process_folder import is_in_use, own_folders
from semantic_mapper.nodes.supervisor.launch_config import STATUS_SOCKET

START_S = 180.0  # how long nodes may take to start
LISTEN_S = 0.5
LIVE = "live"  # on the command line: the mapper of the one launch that runs here
QUERY_SOCKET = "query"  # where a mapper answers unless its launch file says otherwise


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
        TransportError: none runs, several do, or the folder is none of a launch.
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
    from semantic_mapper.nodes.supervisor.launch_view import LaunchView
    from semantic_mapper.transport.sockets import NewestSubscriber

    view, deadline = LaunchView(), time.monotonic() + START_S
    status = f"ipc://{folder}/{STATUS_SOCKET}"
    with NewestSubscriber(status, ("status",)) as subscriber:
        while not (view.complete and view.all_ready):
            view.listen(subscriber, LISTEN_S)
            if time.monotonic() > deadline:
                raise TransportError(
                    f"{status}: its nodes have not all come to run for {START_S:g} s; see `view --status`"
                )
    nodes = view.to_json()["nodes"].items()
    return {name: f"ipc://{folder}/{name}" for name, node in nodes if node["state"] != "ended"}


def status_endpoint(place: str) -> str:
    """Where the launcher of a running launch publishes how it goes.

    Args:
        place: An endpoint, or a socket folder; empty = that of the one launch that runs.

    Raises:
        TransportError: none runs, several do, or the folder is none of a launch.
    """
    return place if "://" in place else f"ipc://{launch_folder(place)}/{STATUS_SOCKET}"
