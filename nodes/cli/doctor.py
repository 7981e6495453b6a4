"""``semantic-mapper doctor``: what is missing on this machine and how to fix it, and which cameras it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from semantic_mapper.drivers.registry import KINDS, find_cameras
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOption, verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.doctor.machine import examine
from semantic_mapper.nodes.launcher.launch_file import find_launch

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
    cameras: Annotated[
        bool, typer.Option("--cameras", help="List the cameras that are connected instead, as a config names them.")
    ] = False,
    kind: Annotated[
        list[str] | None,
        typer.Option(help="--cameras: only this kind (v4l2, stereo, oak, realsense); may be repeated."),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Look for what this machine lacks, with a fix for each thing; or list its cameras.

    Exit code 1 where something needed is missing. Video files and streams (kind opencv) are named, not found. A kind of
    camera whose packages are missing is reported, too.

    Example: semantic-mapper doctor
    Example: semantic-mapper doctor onboard --set keys=~/.config/semantic-mapper/keys
    Example: semantic-mapper doctor --cameras --kind v4l2 --json
    """
    if kind and not cameras:
        raise typer.BadParameter("goes with --cameras", param_hint="--kind")
    output = Output.guarded()
    if cameras:
        _list_cameras(output, kind or (), json)
        return 0

    checks = examine(find_launch(launch) if launch else None, settings or ())
    if json:
        output.json([asdict(c) for c in checks])
    else:
        table = Table(title="doctor", title_justify="left")
        for title in ("", "what", "found", "fix"):
            table.add_column(title, overflow="fold")
        for check in checks:
            table.add_row(Text(check.state, _STYLES[check.state]), check.name, check.found, check.fix)
        output.print(table)
    return EXIT_FAILED if any(c.state == "bad" for c in checks) else 0


def _list_cameras(output: Output, kinds: Sequence[str], json: bool) -> None:

    found, unknown = find_cameras(tuple(kinds) or KINDS)
    if json:
        output.json({"cameras": [asdict(camera) for camera in found], "unknown": unknown})
        return
    if found:
        table = Table(title="cameras", title_justify="left")
        for title in ("kind", "name", "address", "note"):
            table.add_column(title, overflow="fold")
        for camera in found:
            table.add_row(camera.kind, camera.name, camera.address, camera.note)
        output.print(table)
    else:
        output.print("no camera is connected")
    for name, reason in unknown.items():
        output.print(f"{name}: cannot be searched: {reason}")
