"""``semantic-mapper query``: ask a saved map, or that of a running mapper."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from semantic_mapper.errors import MapError
from semantic_mapper.nodes.cli.remote import KeysOption, ServerOption, server_identity
from semantic_mapper.nodes.cli.verb import JsonOption, results_file, verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.supervisor.running_launches import map_endpoint
from semantic_mapper.replay.run_folder import prepare_file

if TYPE_CHECKING:
    from semantic_mapper.queries.graph import SceneGraph
    from semantic_mapper.queries.snapshot import MapSnapshot


class Question(StrEnum):
    """What can be asked."""

    INFO = "info"
    AT = "at"
    NEAREST = "nearest"
    INSTANCES = "instances"
    GRAPH = "graph"


ARGUMENTS = {Question.AT: "X Y Z", Question.NEAREST: "CLASS X Y Z"}


class Asked(NamedTuple):
    """A question and what it may need; see the options of ``query``."""

    question: Question
    class_name: str = ""
    point: tuple[float, ...] = ()
    up: tuple[float, float, float] | None = None
    min_confidence: float = 0.0
    server: str = ""
    keys: Path | None = None
    gone: bool = False
    picture: Path | None = None


@verb
def query(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MAP",
            help="Saved map, folder of results, `live` for the launch that runs here, ipc://PATH or tcp://HOST:PORT.",
        ),
    ],
    question: Annotated[Question, typer.Argument(metavar="QUESTION", help="info, at, nearest, instances or graph.")],
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[CLASS] [X Y Z]", help="Class, and world coordinates in metres.")
    ] = None,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y Z",
            help="instances, graph: which way is up in the world.  [default: away from the floor; instances of a "
            "running mapper, or where no floor was seen: 0 0 1]",
        ),
    ] = None,
    min_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="nearest: places less sure of the class do not count.")
    ] = 0.0,
    gone: Annotated[
        bool, typer.Option("--gone", help="Running mapper, instances: also those of earlier answers that have gone.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="graph: also draw rooms, doors and objects from above.")
    ] = None,
    server: ServerOption = "",
    keys: KeysOption = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the answer here, as JSON.")] = None,
    json: JsonOption = False,
) -> None:
    """Ask a saved map, or that of a running mapper, what is where.

    info: size, classes and how much surface each has. at: class and confidence of the surface at a point, and whether
    the point is free, occupied or unknown. nearest: the surface of a class that is nearest to a point. instances: all
    things, that is, connected pieces of one class that is not wall, floor or the like, with upright boxes; of a map
    that `refine` has told things apart in, those. graph: floors, their rooms, which part at doors, the doors between
    them, and the same things with their rooms.

    Example: semantic-mapper query runs/demo info
    Example: semantic-mapper query runs/demo/map.npz at 1.2 -0.4 0.8
    Example: semantic-mapper query runs/demo/map.npz nearest chair 0 0 1 --min-confidence 0.5
    Example: semantic-mapper query runs/demo/map.npz instances --up 0 0 1 --out things.json
    Example: semantic-mapper query runs/demo graph --picture rooms.png --out graph.json
    Example: semantic-mapper query live nearest chair 0 0 1 --json
    Example: semantic-mapper query live instances --gone --json
    Example: semantic-mapper query tcp://robot:5570 info --server robot
    """
    class_name, point = _read_arguments(question, arguments or [])
    endpoint = map_endpoint(source)
    if gone and not (endpoint and question is Question.INSTANCES):
        raise typer.BadParameter("goes with `instances` of a running mapper", param_hint="--gone")
    if picture is not None and question is not Question.GRAPH:
        raise typer.BadParameter("goes with `graph`", param_hint="--picture")
    output = Output.guarded()
    from semantic_mapper.files import write_json
    from semantic_mapper.nodes.map_answers import answer_table

    out, output.quiet = results_file(out), json
    for path in (out, picture):
        if path is not None:
            prepare_file(path)
    ask = ask_mapper if endpoint else ask_file
    asked = Asked(question, class_name, point, up, min_confidence, server, keys, gone, picture)
    found = {"map": source, **ask(endpoint or source, asked)}
    if out is not None:
        write_json(out, found)
    if output.quiet:
        output.json(found)
    output.print(answer_table(found, output.console.width))
    for path in (out, picture):
        if path is not None:
            output.print(f"written to {path}")


def ask_file(source: str, asked: Asked) -> dict[str, Any]:
    """Answer of a saved map.

    Raises:
        ConfigError, MapError, LabelError: no map there, or a question that cannot be answered.
    """
    from semantic_mapper.nodes import map_answers
    from semantic_mapper.queries.graph import GraphTracker
    from semantic_mapper.queries.instances import InstanceTracker
    from semantic_mapper.queries.mirror import MapMirror
    from semantic_mapper.queries.nearest import at, nearest
    from semantic_mapper.replay.run_folder import map_path

    snapshot = MapMirror.load(map_path(Path(source))).snapshot()
    match asked.question:
        case Question.INFO:
            return map_answers.describe_map(snapshot)
        case Question.AT:
            return map_answers.answer_at(snapshot.label_set, asked.point, at(snapshot, [asked.point]))
        case Question.NEAREST:
            hit = nearest(snapshot, asked.class_name, asked.point, asked.min_confidence)
            return map_answers.answer_nearest(asked.class_name, asked.point, hit)
        case Question.INSTANCES:
            by = map_answers.CONNECTED if snapshot.instances is None else map_answers.LEARNED
            up = asked.up or _find_up(snapshot)
            return map_answers.answer_instances(up, InstanceTracker(up=up).update(snapshot), by)
        case Question.GRAPH:
            return _answer_graph(source, GraphTracker(asked.up).update(snapshot), asked.picture)


def _find_up(snapshot: MapSnapshot) -> tuple[float, ...]:
    """Away from the floor, as in the graph; z of the world where no floor shows it, which the answer tells (``up``)."""
    from semantic_mapper.nodes.map_answers import UP
    from semantic_mapper.queries.graph import GraphTracker

    try:
        return tuple(GraphTracker().up_in(snapshot).tolist())
    except MapError:
        return UP


def ask_mapper(source: str, asked: Asked) -> dict[str, Any]:
    """The same of a running mapper.

    Raises:
        TransportError: nobody answers there.
        MapError, LabelError: a question that cannot be answered.
    """
    from semantic_mapper.client import MapClient
    from semantic_mapper.nodes import map_answers

    with MapClient(source, identity=server_identity(asked.server, asked.keys)) as client:
        match asked.question:
            case Question.INFO:
                return map_answers.describe_map(client.mirror().snapshot())
            case Question.AT:
                return map_answers.answer_at(client.info().label_set, asked.point, client.at([asked.point]))
            case Question.NEAREST:
                hit = client.nearest(asked.class_name, asked.point, asked.min_confidence)
                return map_answers.answer_nearest(asked.class_name, asked.point, hit)
            case Question.INSTANCES:
                up = asked.up or map_answers.UP
                return map_answers.answer_instances(up, client.instances(up, gone=asked.gone), map_answers.CONNECTED)
            case Question.GRAPH:
                return _answer_graph(source, client.graph(asked.up), asked.picture)


def _answer_graph(source: str, graph: SceneGraph, picture: Path | None) -> dict[str, Any]:
    """Also draws it.

    Raises:
        MapError: there is no floor to draw.
    """
    from semantic_mapper.nodes import map_answers

    if picture is not None:
        from semantic_mapper.plots import write_picture
        from semantic_mapper.queries.graph_picture import draw_graph

        if not graph.floors:
            raise MapError(f"{source}: there is nothing to draw: {map_answers.NO_FLOOR}")
        write_picture(picture, draw_graph(source, graph))
    return map_answers.answer_graph(graph)


def _read_arguments(question: Question, arguments: list[str]) -> tuple[str, tuple[float, ...]]:
    """Class name and point, as far as the question has them."""
    expected = ARGUMENTS.get(question, "").split()
    if len(arguments) != len(expected):
        raise typer.BadParameter(
            f"`{question.value}` takes {' '.join(expected) or 'nothing more'}, got {' '.join(arguments) or 'nothing'}"
        )
    name = arguments[0] if question is Question.NEAREST else ""
    try:
        return name, tuple(float(a) for a in arguments[-3:])
    except ValueError as error:
        raise typer.BadParameter(f"X Y Z must be numbers, got {' '.join(arguments[-3:])}") from error
