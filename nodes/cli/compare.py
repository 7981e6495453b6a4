"""``semantic-mapper compare``: do two runs of one log come to the same?"""

from __future__ import annotations

import filecmp
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.cli.verb import show_error, verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.replay.compare import Difference, Tolerances, compare_runs, read_run
from semantic_mapper.replay.run_folder import map_path

EXIT_DIFFERS = 1
EXIT_TROUBLE = 2

RunArgument = typer.Argument(help="Folder that `replay` or `up` has written, or a map.npz.")


@verb
def compare(
    a: Annotated[Path, RunArgument],
    b: Annotated[Path, RunArgument],
    score: Annotated[
        float | None, typer.Option(min=0, help="Allowed of mIoU and accuracies.  [default: 0.005]")
    ] = None,
    surface_m: Annotated[
        float | None, typer.Option(min=0, help="Allowed distance of the surfaces, metres.  [default: 0.005]")
    ] = None,
    labels: Annotated[
        float | None, typer.Option(min=0, help="Allowed fraction of points with another class.  [default: 0.01]")
    ] = None,
    exact: Annotated[bool, typer.Option("--exact", help="The maps must be the same, byte for byte.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Compare two runs of one log: counts, scores, and how far the maps are apart.

    Exit codes: 0 equal, 1 different, 2 wrong usage, or something that cannot be read.

    Example: semantic-mapper compare runs/before runs/after
    Example: semantic-mapper compare runs/before runs/after --labels 0.05
    Example: semantic-mapper compare a/map.npz b/map.npz --exact --json
    """
    output = Output.guarded()
    given = {"score": score, "surface_m": surface_m, "labels": labels}
    tolerances = Tolerances(**{name: value for name, value in given.items() if value is not None})
    try:
        comparison = compare_runs(read_run(a), read_run(b), tolerances)
        if exact:
            other = 0 if filecmp.cmp(map_path(a), map_path(b), shallow=False) else 1
            comparison.figures.append(Difference("other bytes", None, None, other))
    except SemanticMapperError as error:
        show_error(str(error))
        return EXIT_TROUBLE
    if json:
        output.json({"a": str(a), "b": str(b), **comparison.to_plain()})
    else:
        for line in (*comparison.figures, *comparison.notes):
            output.print(str(line))
        different = ", ".join(figure.name for figure in comparison.differences)
        output.print(f"different: {different}" if different else "equal")
    return 0 if comparison.equal else EXIT_DIFFERS
