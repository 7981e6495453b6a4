"""``semantic-mapper weights``: which weights a running mapper uses, and back to earlier ones."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer
from msgspec import to_builtins

from semantic_mapper.errors import MapError
from semantic_mapper.nodes.cli.remote import KeysOption, ServerOption, server_identity
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.plain_text import counted

if TYPE_CHECKING:
    from semantic_mapper.client import MapClient, Weights

POLL_S = 0.2
PATIENCE_S = 60.0  # in which a mapper that gets frames has long read the file


@verb
def weights(
    endpoint: Annotated[
        str,
        typer.Argument(
            help="`live` for the launch that runs here, or where its mapper answers (ipc://PATH, tcp://HOST:PORT)."
        ),
    ],
    rollback: Annotated[
        bool, typer.Option("--rollback", help="Return to the weights that were in use before.")
    ] = False,
    rollback_to: Annotated[
        int | None,
        typer.Option(min=0, metavar="VERSION", help="Return to this version; 0 = that which the mapper started with."),
    ] = None,
    server: ServerOption = "",
    keys: KeysOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """List the weights that a running mapper was offered, with what became of them; go back to earlier ones.

    What is in the map stays. A finetuner forgets the keyframes that only later weights were made with.

    Example: semantic-mapper weights live
    Example: semantic-mapper weights live --rollback
    """
    output = Output.guarded()
    from semantic_mapper.client import MapClient
    from semantic_mapper.nodes.launcher.running import map_endpoint

    endpoint = map_endpoint(endpoint) or endpoint
    with MapClient(endpoint, identity=server_identity(server, keys)) as client:
        state = _go_back(client, rollback_to) if rollback or rollback_to is not None else client.weights()
    if json:
        output.json(describe(state))
    else:
        output.print(weights_table(state))


def describe(state: Weights) -> dict[str, Any]:
    """As plain data."""
    return {
        "in_use": state.in_use,
        "before": state.before,
        "taken": state.taken,
        "refused": state.refused,
        "rolled_back": state.rolled_back,
        "versions": [to_builtins(v) for v in state.versions],
    }


def _go_back(client: MapClient, version: int | None) -> Weights:
    """Ask, and wait until it has been done.

    Raises:
        MapError: there is nothing to go back to, or the mapper could not.
    """
    if version is None:
        version = client.weights().before
        if version is None:
            raise MapError("no other weights were in use before these")
    state = client.return_to_weights(version)
    deadline = time.monotonic() + PATIENCE_S
    while state.wanted is not None and time.monotonic() < deadline:
        time.sleep(POLL_S)
        state = client.weights()
    if state.in_use != version:
        why = "its log says why" if state.wanted is None else f"not within {PATIENCE_S:g} s: does it get frames?"
        raise MapError(f"the mapper did not go back to weights {version}: {why}")
    return state


def weights_table(state: Weights) -> Any:
    """For people."""
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table(
        title=f"weights {state.in_use} in use; {counted(state.taken, 'time')} taken, {state.refused} refused, "
        f"{state.rolled_back} rolled back",
        title_justify="left",
        box=SIMPLE,
    )
    for heading in ("version", "state", "keyframes", "mIoU held out", "of those before", "file", "reason"):
        table.add_column(heading, justify="left" if heading in ("state", "file", "reason") else "right")
    for v in state.versions:
        scores = (f"{v.score * 100:.1f} %", f"{v.parent_score * 100:.1f} %") if v.version else ("", "")
        table.add_row(str(v.version), v.state, str(v.keyframes or ""), *scores, v.digest[:12], v.reason)
    return table
