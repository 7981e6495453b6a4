"""``semantic-mapper refine``: a network that has seen many maps corrects the classes of a saved one."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.replay.run_folder import map_path, refuse_overwriting

if TYPE_CHECKING:
    from rich.table import Table

    from semantic_mapper.mapping.refine import RefineReport


@verb
def refine(
    source: Annotated[Path, typer.Argument(metavar="MAP", help="Saved map, or a folder of results with one.")],
    out: Annotated[Path, typer.Option("--out", help="Map to write (.npz).")],
    weights: Annotated[
        Path | None,
        typer.Option(
            help="From `train --kind nesf`; 'smoothed' smooths votes over neighbouring surface. Without it: the "
            "weights that ship, or smoothed votes for a map of other classes."
        ),
    ] = None,
    fill: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, help="Surface without votes gets a class that is at least so likely; 1 = never."
        ),
    ] = 0.5,
    up: Annotated[
        str, typer.Option(help="Up in the world: x, -y, ..., or three numbers; auto = away from the floor.")
    ] = "auto",
    by_name: Annotated[
        bool, typer.Option("--by-name", help="Weights of other classes: take those with the same name in both.")
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the outcome as JSON, and nothing else, on stdout.")
    ] = False,
) -> None:
    """Relabel a saved map by its shape, colour and votes, and label surface that nothing voted for.

    A network decides that has seen many maps. For a map of other classes than its own, and with --weights smoothed,
    votes are smoothed over surface of the same slope within some 6 cm; nothing is learned then.

    Writes a map like any other: query, export, merge it, or go on mapping into it. Geometry and colours are unchanged.

    Example: semantic-mapper refine runs/kitchen/map.npz --out refined.npz
    Example: semantic-mapper refine runs/kitchen/map.npz --out refined.npz --weights smoothed
    """
    if by_name and weights is None:
        raise typer.BadParameter("goes with --weights; without, other classes are smoothed", param_hint="--by-name")
    output = Output.guarded()
    output.quiet = json
    path = map_path(source)
    refuse_overwriting(out, path)
    from semantic_mapper.fields.nesf import SHIPPED, SMOOTHED, SMOOTHING
    from semantic_mapper.replay.jobs import refine_map

    with frame_progress("refine", None, unit="tiles") as bar:
        result = refine_map(path, out, weights, fill=fill, up=up, by_name=by_name, monitor=bar)
    report = result.report
    output.print(_table(report))
    if result.weights != SMOOTHED:
        output.print(f"refined by the weights {weights or SHIPPED}")
        if not report.voted:
            output.print("the map had no votes: its classes are guessed from shape and colour")
    elif weights == SMOOTHING:
        output.print("the votes were smoothed, nothing was learned")
    else:
        output.print(f"no weights ship for label set '{result.label_set}': the votes were smoothed")
    relabelled, filled = (100 * count / max(report.surface, 1) for count in (report.relabelled, report.filled))
    output.print(f"{out}: {relabelled:.1f} % of the surface relabelled, {filled:.1f} % filled")
    if json:
        output.json(asdict(report) | {"weights": result.weights, "out": str(out)})


def _table(report: RefineReport) -> Table:
    """Fraction of the surface by class; classes that it never has are left out."""
    from rich.table import Table

    table = Table(title="fraction of the surface", title_justify="left")
    table.add_column("")
    for column in ("before", "after"):
        table.add_column(column, justify="right")
    for name, before in report.before.items():
        after = report.after[name]
        if before or after:
            table.add_row(name, *(f"{100 * count / max(report.surface, 1):.1f} %" for count in (before, after)))
    return table
