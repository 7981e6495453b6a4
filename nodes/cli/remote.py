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


def server_identity(server: str, keys: Path | None) -> ServerIdentity | None:
    """Whom to expect at the other end; None where no server is named.

    Raises:
        TransportError: no keys.
    """
    from semantic_mapper.transport.keys import ServerIdentity, load_keys, user_key_folder

    if not server:
        return None
    return ServerIdentity(load_keys(keys or user_key_folder()), server)
