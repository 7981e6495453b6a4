"""``semantic-mapper keys``: who may connect from other machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.nodes.cli.verb import JsonOption, verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.transport import keys as security

Action = Literal["make", "show", "allow", "forget"]


@verb
def keys(
    action: Annotated[Action, typer.Argument(help="make, show, allow NAME KEY, or forget NAME.")],
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="What to call the other machine.")] = "",
    key: Annotated[
        str, typer.Argument(metavar="[KEY]", help="Its public key, as `semantic-mapper keys show` there says.")
    ] = "",
    folder: Annotated[Path | None, typer.Option("--keys", help="Folder of the keys; without it this user's.")] = None,
    json: JsonOption = False,
) -> None:
    """Make, show or exchange the keys by which machines know each other.

    They are needed where a node listens beyond this machine. make: keys for this machine. show: its public key, and the
    peers it lets in. allow: let a machine in, and know it when connecting to it; counts at once for nodes that run.
    forget: let a machine in no more; connections that it has end when it next connects.

    Example: semantic-mapper keys make
    Example: semantic-mapper keys allow workstation 'rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7'
    """
    if bool(name) != (action in ("allow", "forget")) or bool(key) != (action == "allow"):
        raise typer.BadParameter("write make, show, allow NAME KEY, or forget NAME", param_hint="ACTION")
    output = Output.guarded()
    folder = folder or security.user_key_folder()
    if action == "make":
        public = security.make_keys(folder).public.decode()
        output.print(public)
        output.print(f"is this machine's public key; on another one: semantic-mapper keys allow NAME '{public}'")
    elif action == "show":
        _show(output, folder, json)
    elif action == "allow":
        security.allow(folder, name, key)
        output.print(f"'{name}' is a peer")
    else:
        security.forget(folder, name)
        output.print(f"'{name}' is no peer any more")


def _show(output: Output, folder: Path, json: bool) -> None:
    own = security.load_keys(folder)
    peers = {name: key.decode() for name, key in own.peers().items()}
    if json:
        output.json({"folder": str(folder), "public": own.public.decode(), "peers": peers})
        return
    output.print(f"{own.public.decode()}  this machine ({folder})")
    for name, key in peers.items():
        output.print(f"{key}  {name}")
    if not peers:
        output.print("no peers yet: semantic-mapper keys allow NAME KEY")
