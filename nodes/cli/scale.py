"""``semantic-mapper scale``: a map without metres gets them."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.config import HeightM
from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.verb import JsonOutput, WeightsOption, must_be_there, refuse_options, verb
from semantic_mapper.nodes.console import frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.exporters.map_files import parse_numbers
from semantic_mapper.replay.summary import ending
from semantic_mapper.types import Float64


@verb
def scale(
    output: JsonOutput,
    run: Annotated[Path, typer.Argument(metavar="RUN")],  # folder of results of `map`, with the log
    *,
    # two points of the map, x,y,z each, as `view` and `query` give them, and the metres between them
    known: Annotated[tuple[str, str, float] | None, typer.Option(metavar="A B METRES")] = None,
    height: HeightM = 0.0,  # in their place: of the camera over the floor, metres, the median of its path
    weights: WeightsOption = None,
) -> int:
    """Give the map of a film metres, and map it again.

    Poses are not found again, but scaled; voxels and classes depend on metres, so that the log is mapped with the
    settings of before. Log and results in RUN are replaced once the new ones are whole. A map with measured depth is
    refused: it is in metres.

    Example: semantic-mapper scale runs/film --known 1.2,0.3,0.7 1.9,0,0.7 0.75
    Example: semantic-mapper scale runs/film --height 1.5
    """
    refuse_options(
        (bool(known) == bool(height), "--known, --height", "give one of them"),
        (known and not known[2] > 0, "--known", "the distance must be larger than 0"),
    )
    must_be_there(run)
    from semantic_mapper.replay.rescale import rescale_run

    points = None if known is None else (_point(known[0]), _point(known[1]))
    with StopRequest() as stop:
        with frame_progress("map", None, stop=stop) as bar:
            report = rescale_run(run, height if known is None else known[2], points, weights, bar)
        if report.summary["stopped_by"]:
            stderr_console().print(f"stopped by {stop.name}; {run} is as it was", style="yellow")
            return stop.exit_code
    output.json(asdict(report))
    output.print(f"{run}: lengths are {report.factor:.4g} times those of before, in metres; scale: {report.scale}")
    for line in ending(report.summary, run):
        output.print(line)
    return 0


def _point(text: str) -> Float64:
    point = parse_numbers(text)
    if point is None or point.shape != (3,):
        raise ConfigError(f"--known {text}: is no point; write x,y,z, such as 1.20,-0.35,0.74")
    return point
