"""``semantic-mapper doctor``: what is missing on this machine, and how to mend it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.verb import EXIT_FAILED, verb
from semantic_mapper.nodes.console import Output

_STYLES = {"ok": "green", "note": "yellow", "bad": "bold red"}


@verb
def doctor(
    launch: Annotated[
        Path | None,
        typer.Argument(metavar="[LAUNCH.toml]", help="A launch file whose ports and keys are looked at, too."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="For the launch file, as of `up`; may be repeated."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Look for what this machine lacks, with a mend for each thing; exit code 1 where something needed is missing.

    Example: semantic-mapper doctor
    Example: semantic-mapper doctor onboard --set keys=~/.config/semantic-mapper/keys
    """
    output = Output.guarded()
    from rich.table import Table
    from rich.text import Text

    from semantic_mapper.nodes.doctor.machine import examine
    from semantic_mapper.nodes.launcher.launch_file import find_launch

    checks = examine(find_launch(launch) if launch else None, settings or ())
    if json:
        output.json([asdict(c) for c in checks])
    else:
        table = Table(title="doctor", title_justify="left")
        for title in ("", "what", "found", "mend"):
            table.add_column(title, overflow="fold")
        for check in checks:
            table.add_row(Text(check.state, _STYLES[check.state]), check.name, check.found, check.mend)
        output.print(table)
    return EXIT_FAILED if any(c.state == "bad" for c in checks) else 0
