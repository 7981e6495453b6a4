"""``semantic-mapper fleet``: operations over many logs and maps."""

from __future__ import annotations

import typer

from semantic_mapper.nodes.cli.fleet_merge import merge

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Operations over many logs and maps, on this machine or a Ray cluster.",
)


@app.callback()
def _options() -> None:
    """A callback keeps ``merge`` a verb of its own while it is the only one."""


app.command("merge")(merge)
