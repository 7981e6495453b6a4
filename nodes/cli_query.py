"""``semantic-mapper query``: ask a saved map."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from nodes.console import Output
from nodes.outputs import prepare_file
from nodes.verb import verb


class Question(StrEnum):
    """What can be asked."""

    INFO = "info"
    AT = "at"
    NEAREST = "nearest"
    INSTANCES = "instances"


ARGUMENTS = {Question.INFO: "", Question.AT: "X Y Z", Question.NEAREST: "CLASS X Y Z", Question.INSTANCES: ""}


@verb
def query(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="Saved map (map.npz).")],
    question: Annotated[Question, typer.Argument(metavar="QUESTION", help="info, at, nearest or instances.")],
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[CLASS] [X Y Z]", help="Class, and world coordinates in metres.")
    ] = None,
    up: Annotated[
        tuple[float, float, float], typer.Option(metavar="X Y Z", help="instances: which way is up in the world.")
    ] = (0.0, 0.0, 1.0),
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the answer here.")
    ] = None,
) -> None:
    """Ask a saved map what is where.

    info: size, classes and how much surface each has. at: class and confidence of the surface at a point, and whether
    the point is free, occupied or unknown. nearest: the surface of a class that is nearest to a point. instances: all
    things, that is, connected pieces of one class that is not wall, floor or the like, with upright boxes.

    Example: semantic-mapper query runs/demo/map.npz info
    Example: semantic-mapper query runs/demo/map.npz at 1.2 -0.4 0.8
    Example: semantic-mapper query runs/demo/map.npz nearest chair 0 0 1
    Example: semantic-mapper query runs/demo/map.npz instances --up 0 0 1 --json things.json
    """
    class_name, point = _read_arguments(question, arguments or [])
    output = Output.guarded()
    from nodes import map_answers
    from replay.artifacts import write_json
    from semantic_mapper.mapping.voxel_map import VoxelMap
    from semantic_mapper.queries.mirror import MapMirror

    if json_file is not None:
        prepare_file(json_file)
    voxel_map = VoxelMap.load(map_file)
    snapshot = MapMirror.of(voxel_map).snapshot()
    if question is Question.INFO:
        found = map_answers.describe_map(snapshot)
    elif question is Question.AT:
        found = map_answers.answer_at(snapshot, point)
    elif question is Question.NEAREST:
        found = map_answers.answer_nearest(snapshot, class_name, point)
    else:
        found = map_answers.answer_instances(snapshot, up)
    found = {"map": str(map_file), **found}
    output.print(map_answers.answer_table(found))
    if json_file is not None:
        write_json(json_file, found)
        output.print(f"written to {json_file}")


def _read_arguments(question: Question, arguments: list[str]) -> tuple[str, tuple[float, ...]]:
    """Class name and point, as far as the question has them."""
    expected = ARGUMENTS[question].split()
    if len(arguments) != len(expected):
        raise typer.BadParameter(
            f"`{question.value}` takes {ARGUMENTS[question] or 'nothing more'}, got {' '.join(arguments) or 'nothing'}"
        )
    name = arguments[0] if question is Question.NEAREST else ""
    try:
        return name, tuple(float(a) for a in arguments[-3:])
    except ValueError as error:
        raise typer.BadParameter(f"X Y Z must be numbers, got {' '.join(arguments[-3:])}") from error
