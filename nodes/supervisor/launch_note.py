"""What a launch is, left in its socket folder: for logs that keep it, and for those who join it from outside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from semantic_mapper.config import MAX_FILE_BYTES
from semantic_mapper.errors import TransportError
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.nodes.supervisor.launch_config import Launch
from semantic_mapper.redaction import without_secrets

NOTE = "launch.json"


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
        TransportError: there is none, or it cannot be understood.
    """
    try:
        return msgspec.json.decode(read_regular(folder / NOTE, MAX_FILE_BYTES), type=LaunchNote)
    except OSError as error:
        raise TransportError(
            f"{folder}: no socket folder of a launch ({error.strerror}); `up` names its own"
        ) from error
    except msgspec.DecodeError as error:
        raise TransportError(f"{folder / NOTE}: {error}; does another version of the package run there?") from error
