"""``semantic-mapper keys``: who may connect from other machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Keys by which this machine and others know each other. Needed where a node listens beyond this machine.",
)


def _user_folder() -> Path:
    from semantic_mapper.transport.keys import user_key_folder

    return user_key_folder()


FolderOption = Annotated[Path, typer.Option("--keys", help="Folder of the keys.", default_factory=_user_folder)]


@app.command("make")
@verb
def make(keys: FolderOption) -> int:
    """Make keys for this machine and show the public one.

    Example: semantic-mapper keys make
    """
    output = Output.guarded()
    from semantic_mapper.transport.keys import make_keys

    made = make_keys(keys)
    public = made.public.decode()
    output.print(public)
    output.print(f"is this machine's public key; on another one: semantic-mapper keys allow NAME '{public}'")
    return 0


@app.command("show")
@verb
def show(
    keys: FolderOption,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Show this machine's public key, and the peers it lets in.

    Example: semantic-mapper keys show
    """
    output = Output.guarded()
    from semantic_mapper.transport.keys import load_keys

    own = load_keys(keys)
    peers = {name: key.decode() for name, key in own.peers().items()}
    if json:
        output.json({"folder": str(keys), "public": own.public.decode(), "peers": peers})
        return 0
    output.print(f"{own.public.decode()}  this machine ({keys})")
    for name, key in peers.items():
        output.print(f"{key}  {name}")
    if not peers:
        output.print("no peers yet: semantic-mapper keys allow NAME KEY")
    return 0


@app.command("allow", context_settings={"ignore_unknown_options": True})  # keys may begin with a dash
@verb
def allow(
    name: Annotated[str, typer.Argument(help="What to call the other machine.")],
    key: Annotated[str, typer.Argument(help="Its public key, as `semantic-mapper keys show` there says.")],
    keys: FolderOption,
) -> int:
    """Let another machine in, and know it when connecting to it. Counts at once for nodes that run.

    Example: semantic-mapper keys allow workstation 'rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7'
    """
    output = Output.guarded()
    from semantic_mapper.transport.keys import allow as allow_peer

    allow_peer(keys, name, key)
    output.print(f"'{name}' is a peer")
    return 0


@app.command("forget")
@verb
def forget(
    name: Annotated[str, typer.Argument(help="The peer to remove.")],
    keys: FolderOption,
) -> int:
    """Let a machine in no more; connections that it has end when it next connects.

    Example: semantic-mapper keys forget workstation
    """
    output = Output.guarded()
    from semantic_mapper.transport.keys import forget as forget_peer

    forget_peer(keys, name)
    output.print(f"'{name}' is no peer any more")
    return 0
