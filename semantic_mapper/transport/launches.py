"""Launches of this user that run on this machine, and where the mapper answers that somebody means by a name.

A launch leaves a note in its socket folder: for logs that keep it, and for those who join it from outside.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from semantic_mapper.config import MAX_FILE_BYTES
from semantic_mapper.errors import TransportError
from semantic_mapper.files import read_regular
from semantic_mapper.transport.process_folder import is_in_use, own_folders

if TYPE_CHECKING:
    from semantic_mapper.transport.keys import ServerIdentity

NOTE = "launch.json"
STATUS_SOCKET = "launch"  # where the launcher publishes how all nodes are
LIVE = "live"  # the one launch that runs here
QUERY_SOCKET = "query"  # where a mapper answers unless its launch file says otherwise
_ANY_HOST = {"0.0.0.0": "127.0.0.1", "*": "127.0.0.1", "[::]": "[::1]"}  # bound there, it is reached here


class LaunchedNode(msgspec.Struct, frozen=True):
    """A node of a launch, with all its options."""

    name: str
    kind: str  # camera, mapper, ...
    options: dict[str, Any] = msgspec.field(default_factory=dict)


class LaunchNote(msgspec.Struct, frozen=True):
    """What a launch is."""

    launch: str  # name of its file
    nodes: tuple[LaunchedNode, ...]  # in the order of the file

    def names(self, kind: str) -> tuple[str, ...]:
        """Nodes of a kind."""
        return tuple(node.name for node in self.nodes if node.kind == kind)


class MapperAddress(NamedTuple):
    """Where a mapper answers, and whom to expect there; None = anybody of this machine."""

    endpoint: str
    identity: ServerIdentity | None = None


def read_launch_note(folder: Path) -> LaunchNote:
    """Of a launch that runs. Raises TransportError: there is no launch, or it cannot be understood."""
    try:
        return msgspec.json.decode(read_regular(folder / NOTE, MAX_FILE_BYTES), type=LaunchNote)
    except (OSError, msgspec.DecodeError) as error:
        raise TransportError(f"{folder / NOTE}: no note of a launch: {error}; `up` names its folder") from error


def running_launches() -> list[Path]:
    """Socket folders of the launches that run, the newest first."""
    found: list[tuple[int, Path]] = []
    for folder in own_folders():
        try:
            stat = folder.stat()
            if stat.st_uid == os.getuid() and (folder / STATUS_SOCKET).exists() and is_in_use(folder):
                found.append((stat.st_ctime_ns, folder))
        except OSError:  # it has just ended, or is another user's
            continue
    return [folder for _, folder in sorted(found, reverse=True)]


def launch_folder(place: str) -> Path:
    """The socket folder of a running launch, which is named by itself, or by its launch file ("replay"); ``live`` and
    an empty place stand for the one launch that runs.

    Raises TransportError: there is no such launch, or several could be meant; names those that run.
    """
    if (Path(place) / STATUS_SOCKET).exists() and place:
        return Path(place).absolute()
    running = running_launches()
    meant = running if place in ("", LIVE) else [folder for folder in running if _is_called(folder, place)]
    if len(meant) == 1:
        return meant[0]
    if meant:
        raise TransportError(f"several launches run here; name one by its file or folder: {_listed(meant)}")
    if place not in ("", LIVE) and Path(place).exists():
        raise TransportError(f"{place}: no socket folder of a launch that runs; `up` names its own as it starts")
    if running:
        raise TransportError(f"{place}: no launch that runs here; there are: {_listed(running)}")
    named = "" if place in ("", LIVE) else f"{place}: "
    raise TransportError(
        f"{named}no launch runs here; `semantic-mapper demo --live` starts one without a camera, `up LAUNCH` any"
    )


def socket_in_launch(place: str, name: str) -> str:
    """The endpoint ``name`` of a running launch, which is named as for ``launch_folder``; endpoints stay as they are.
    Raises TransportError: as of ``launch_folder``."""
    return place if "://" in place else f"ipc://{launch_folder(place)}/{name}"


def find_mapper(place: str) -> MapperAddress:
    """Where the mapper answers that is meant by an endpoint, or by its launch as for ``launch_folder``.

    Raises TransportError: as of ``launch_folder``; or the launch has no mapper that answers, or several.
    """
    if "://" in place:
        return MapperAddress(place)
    folder = launch_folder(place)
    note = read_launch_note(folder)
    found: list[MapperAddress] = []
    for node in note.nodes:
        if node.kind != "mapper" or not (query := node.options.get("query", QUERY_SOCKET)):
            continue
        scheme, separator, address = query.partition("://")
        host, _, port = address.rpartition(":")
        endpoint = f"{scheme}://{_ANY_HOST[host]}:{port}" if host in _ANY_HOST else query
        identity = None
        if keys := node.options.get("keys"):
            from semantic_mapper.transport.keys import server_identity  # loads zmq, of which help has no need

            identity = server_identity(keys=Path(keys).expanduser())
        found.append(MapperAddress(endpoint if separator else f"ipc://{folder}/{query}", identity))
    if len(found) == 1:
        return found[0]
    several = f"several mappers answer; name one: {', '.join(a.endpoint for a in found)}"
    raise TransportError(f"{note.launch} ({folder}): {several if found else 'none of its nodes answers questions'}")


def is_running_mapper(place: str) -> bool:
    """Whether a person means a running mapper by a place (see ``find_mapper``), and not a file, or a folder with a
    saved map. Raises TransportError: it is a socket of this machine that is not there."""
    transport, separator, path = place.partition("://")
    if transport == "ipc" and path and not path.startswith("@") and not Path(path).exists():
        raise TransportError(  # at once, rather than after several attempts
            f"{place}: there is no such socket; does the mapper run? `up` names the socket folder of its launch as "
            "it starts, and its mapper answers at ipc://FOLDER/query"
        )
    if separator or place == LIVE or (Path(place) / STATUS_SOCKET).exists():
        return True
    is_saved = Path(place).is_file() or any(Path(place).glob("*.npz"))
    return not is_saved and any(_is_called(folder, place) for folder in running_launches())


def _is_called(folder: Path, name: str) -> bool:
    return _name(folder).removesuffix(".toml") == name.removesuffix(".toml")


def _name(folder: Path) -> str:
    try:
        return read_launch_note(folder).launch
    except TransportError:  # it has just ended
        return ""


def _listed(folders: Sequence[Path]) -> str:
    return ", ".join(f"{_name(folder)} ({folder})" for folder in folders)
