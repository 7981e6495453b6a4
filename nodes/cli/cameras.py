"""``semantic-mapper cameras``: which cameras are connected, and how a config names them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output


@verb
def cameras(
    kind: Annotated[
        list[str] | None, typer.Option(help="Only this kind (v4l2, stereo, oak, realsense); may be repeated.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """List the cameras that are connected, with the address that a launch file or a config names them by.

    Video files and streams (kind opencv) are named, not found. A kind whose packages are missing is reported, too.

    Example: semantic-mapper cameras
    Example: semantic-mapper cameras --kind v4l2 --json
    """
    output = Output.guarded()
    from rich.table import Table

    from semantic_mapper.drivers.registry import KINDS, find_cameras

    found, unknown = find_cameras(tuple(kind) if kind else KINDS)
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
        output.print(f"{name}: cannot be asked: {reason}")
