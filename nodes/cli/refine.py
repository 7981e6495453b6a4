"""``semantic-mapper refine``: a network that has seen many maps corrects the classes of a saved one."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.config import Fraction
from semantic_mapper.nodes.cli.verb import JsonOutput, UpOption, verb
from semantic_mapper.nodes.console import frame_progress, table
from semantic_mapper.replay.run_folder import map_path, refuse_overwriting


@verb
def refine(
    output: JsonOutput,
    source: Annotated[Path, typer.Argument(metavar="MAP")],  # saved map, or a folder of results with one
    *,
    out: Path,  # map to write (.npz)
    # from `semantic-mapper-research train --kind nesf`; 'smoothed' smooths votes over neighbouring surface. Without it:
    # the weights that ship, or smoothed votes for a map of other classes
    weights: Path | None = None,
    fill: Fraction = 0.5,  # surface without votes gets a class that is at least so likely; 1 = never
    up: UpOption = "auto",
    by_name: bool = False,  # weights of other classes: take those with the same name in both
) -> None:
    """Relabel a saved map by its shape, colour and votes, and label surface that nothing voted for.

    A network decides that has seen many maps. For a map of other classes than its own, and with --weights smoothed,
    votes are smoothed over surface of the same slope within some 6 cm; nothing is learned then.

    Writes a map like any other: query, export, merge it, or go on mapping into it. Geometry and colours are unchanged.

    Example: semantic-mapper refine runs/kitchen/map.npz --out refined.npz
    Example: semantic-mapper refine runs/a --out refined.npz --weights smoothed
    """
    if by_name and weights is None:
        raise typer.BadParameter("goes with --weights; without, other classes are smoothed", param_hint="--by-name")
    path = map_path(source)
    refuse_overwriting(out, path)
    from semantic_mapper.fields.nesf import DEFAULT, SMOOTHED
    from semantic_mapper.replay.refine_map import refine_map

    with frame_progress("refine", None, unit="tiles") as bar:
        report, digest = refine_map(path, out, weights, fill=fill, up=up, by_name=by_name, monitor=bar)

    def percent(count: int) -> str:
        return f"{100 * count / max(report.surface, 1):.1f} %"

    rows = [
        (name, percent(before), percent(report.after[name]))
        for name, before in report.before.items()
        if before or report.after[name]
    ]
    output.print(table(rows, ("", "before", "after"), title="fraction of the surface", numbers=("before", "after")))
    if digest == SMOOTHED:
        output.print("the votes were smoothed, nothing was learned")
    else:
        output.print(f"refined by the weights {(weights or DEFAULT).name}")
    output.print(f"{out}: {percent(report.relabelled)} of the surface relabelled, {percent(report.filled)} filled")
    output.json(asdict(report) | {"weights": digest, "out": str(out)})
