"""``semantic-mapper keys``: who may connect from other machines."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.nodes.cli.verb import JsonOutput, verb
from semantic_mapper.transport import keys as security


@verb
def keys(
    output: JsonOutput,
    action: Literal["make", "show", "allow", "forget"],  # make, show, allow NAME KEY, or forget NAME
    name: str = "",  # what to call the other machine
    key: str = "",  # its public key, as `semantic-mapper keys show` there says
    *,
    # folder of the keys; without it this user's
    folder: Annotated[Path | None, typer.Option("--keys")] = None,
) -> None:
    """Make, show or exchange keys, by which machines connect.

    They are needed where a node listens beyond this machine. make: keys for this machine. show: its public key, and the
    peers it lets in. allow: let a machine in, and know it when connecting to it; counts at once for nodes that run.
    forget: let a machine in no more; connections that it has end when it next connects.

    Example: semantic-mapper keys make
    Example: semantic-mapper keys allow robot 'KEY, AS THE ROBOT SHOWS IT'
    """
    if bool(name) != (action in ("allow", "forget")) or bool(key) != (action == "allow"):
        raise typer.BadParameter("write make, show, allow NAME KEY, or forget NAME", param_hint="ACTION")
    folder = folder or security.user_key_folder()
    if action == "make":
        security.make_keys(folder)
    elif action == "allow":
        security.allow(folder, name, key)
    elif action == "forget":
        security.forget(folder, name)
    own = security.load_keys(folder)
    public, peers = own.public.decode(), {peer: key.decode() for peer, key in own.peers().items()}
    if action in ("make", "show"):
        output.print(f"{public}  this machine; on another one: semantic-mapper keys allow NAME '{public}'")
    for peer, key in peers.items():
        output.print(f"{key}  {peer}")
    if not peers:
        output.print("no peers: semantic-mapper keys allow NAME KEY")
    output.json({"folder": str(folder), "public": public, "peers": peers})
