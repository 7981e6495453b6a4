"""Options by which verbs know a mapper on another machine, and where this user's keys lie."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from semantic_mapper.transport.keys import ServerIdentity

ServerOption = Annotated[
    str,
    typer.Option(help="Name, among the peers of `semantic-mapper keys`, of the machine of a mapper that has keys."),
]
KeysOption = Annotated[
    Path | None, typer.Option("--keys", help="With --server: folder of the keys; without it this user's.")
]


def default_folder() -> Path:
    """Where this user's keys lie unless set otherwise."""
    return Path(typer.get_app_dir("semantic-mapper")) / "keys"


def server_identity(server: str, keys: Path | None) -> ServerIdentity | None:
    """Whom to expect at the other end; None where no server is named.

    Raises:
        TransportError: no keys.
    """
    from semantic_mapper.transport.keys import ServerIdentity, load_keys

    if not server:
        return None
    return ServerIdentity(load_keys(keys or default_folder()), server)
