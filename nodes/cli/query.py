"""``semantic-mapper query``: ask a saved map, or that of a running mapper."""

from __future__ import annotations

import time
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from semantic_mapper.client import Correction, MapClient
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.files import write_json
from semantic_mapper.mapping.map_types import ALWAYS
from semantic_mapper.nodes import map_answers
from semantic_mapper.nodes.cli.options import Remote
from semantic_mapper.nodes.cli.relocalize import all_sessions_found, find_frames, print_frames
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOption, results_file, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.launcher.running import map_endpoint
from semantic_mapper.plots import write_picture
from semantic_mapper.queries.graph import GraphTracker, SceneGraph, draw_graph
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.nearest import at, nearest
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.replay.corrected_poses import MATCH_NS, read_corrections
from semantic_mapper.replay.run_folder import map_path, prepare_file

POLL_S = 0.2


class Question(StrEnum):
    """What can be requested."""

    INFO = "info"
    AT = "at"
    NEAREST = "nearest"
    INSTANCES = "instances"
    GRAPH = "graph"
    CORRECT = "correct"
    RELOCALIZE = "relocalize"


ARGUMENTS = {
    Question.AT: "X Y Z",
    Question.NEAREST: "CLASS X Y Z",
    Question.CORRECT: "FILE",
    Question.RELOCALIZE: "LOG",
}


class Request(NamedTuple):
    """A question and what it may need; see the options of ``query``."""

    question: Question
    class_name: str = ""
    point: tuple[float, ...] = ()
    up: tuple[float, float, float] | None = None
    min_confidence: float = 0.0
    remote: Remote = Remote()
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
    question: Annotated[
        Question,
        typer.Argument(metavar="QUESTION", help="info, at, nearest, instances, graph, correct or relocalize."),
    ],
    remote: Remote,
    arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="[CLASS] [X Y Z] [FILE]", help="Class, and world coordinates in metres; or a file."),
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
        bool,
        typer.Option(
            "--gone", hidden=True, help="Running mapper, instances: also those of earlier answers that have gone."
        ),
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="graph: also draw rooms, doors and objects from above.")
    ] = None,
    camera: Annotated[
        str, typer.Option(hidden=True, help="correct: the camera of the poses; needed where the mapper has several.")
    ] = "",
    apply_until: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="SECONDS",
            hidden=True,
            help="correct: frames after this time are posed in the corrected world already; without it, all that come "
            "after the last pose of the file move with that pose, those to come as well.",
        ),
    ] = None,
    wait: Annotated[
        bool, typer.Option("--wait/--no-wait", hidden=True, help="correct: until the map has moved.")
    ] = True,
    every: Annotated[int, typer.Option(min=1, hidden=True, help="relocalize: look for every n-th frame.")] = 1,
    max_frames: Annotated[
        int, typer.Option("--max-frames", min=0, hidden=True, help="relocalize: of those; 0 = all.")
    ] = 0,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the answer here, as JSON.")] = None,
    json: JsonOption = False,
) -> int:
    """Ask a saved map, or that of a running mapper, what is where.

    info: size, classes and how much surface each has. at: class and confidence of the surface at a point, and whether
    the point is free, occupied or unknown. nearest: the surface of a class that is nearest to a point. instances: all
    things, that is, connected pieces of one class that is not wall, floor or the like, with upright boxes. graph:
    floors, their rooms, which part at doors, the doors between them, and the same things with their rooms.

    correct moves the map of a running mapper to corrected poses (TUM: stamp tx ty tz qx qy qz qw), such as after a
    loop closure. The mapper has to keep its frames (`history.max_frames` in its config). It goes on mapping, and
    exchanges the map when the corrected one is ready. A pose goes to the frame nearest in time, within 5 ms.

    relocalize finds the frames of a log with measured depth in a saved map, each by itself, where features, depth and
    brightness agree with the map; their poses are used only to see whether they agree. Exit code 1 where it is not
    known where a world of the log lies: three frames, and most of those that are found, have to agree on it.

    Example: semantic-mapper query runs/demo info
    Example: semantic-mapper query runs/demo/map.npz nearest chair 0 0 1 --min-confidence 0.5
    Example: semantic-mapper query runs/demo graph --picture rooms.png --out graph.json
    Example: semantic-mapper query tcp://robot:5570 info --server robot
    Example: semantic-mapper query live correct optimised.tum
    Example: semantic-mapper query runs/yesterday relocalize today.mcap
    """
    if question is Question.CORRECT:
        (file,) = _arguments_of(question, arguments or [])
        return _correct(source, Path(file), camera, apply_until, remote, wait=wait, json=json)
    if question is Question.RELOCALIZE:
        (file,) = _arguments_of(question, arguments or [])
        return _relocalize(source, Path(file), every, max_frames, out, json=json)
    class_name, point = _read_arguments(question, arguments or [])
    endpoint = map_endpoint(source)
    if gone and not (endpoint and question is Question.INSTANCES):
        raise typer.BadParameter("goes with `instances` of a running mapper", param_hint="--gone")
    if picture is not None and question is not Question.GRAPH:
        raise typer.BadParameter("goes with `graph`", param_hint="--picture")
    output = Output.guarded()
    out, output.quiet = results_file(out), json
    for path in (out, picture):
        if path is not None:
            prepare_file(path)
    ask = ask_mapper if endpoint else ask_file
    request = Request(question, class_name, point, up, min_confidence, remote, gone, picture)
    found = {"map": source, **ask(endpoint or source, request)}
    if out is not None:
        write_json(out, found)
    if output.quiet:
        output.json(found)
    output.print(map_answers.answer_table(found, output.console.width))
    for path in (out, picture):
        if path is not None:
            output.print(f"written to {path}")
    return 0


def ask_file(source: str, request: Request) -> dict[str, Any]:
    """Answer of a saved map.

    Raises:
        ConfigError, MapError, LabelError: no map there, or a question that cannot be answered.
    """
    snapshot = MapMirror.load(map_path(Path(source))).snapshot()
    match request.question:
        case Question.INFO:
            return map_answers.describe_map(snapshot)
        case Question.AT:
            return map_answers.answer_at(snapshot.label_set, request.point, at(snapshot, [request.point]))
        case Question.NEAREST:
            hit = nearest(snapshot, request.class_name, request.point, request.min_confidence)
            return map_answers.answer_nearest(request.class_name, request.point, hit)
        case Question.INSTANCES:
            up = request.up or _find_up(snapshot)
            found = InstanceTracker(up=up).update(snapshot)
            return map_answers.answer_instances(up, found, map_answers.CONNECTED)
        case _:  # the graph
            return _answer_graph(source, GraphTracker(request.up).update(snapshot), request.picture)


def _find_up(snapshot: MapSnapshot) -> tuple[float, ...]:
    """Away from the floor, as in the graph; z of the world where no floor shows it, which the answer tells (``up``)."""
    try:
        return tuple(GraphTracker().up_in(snapshot).tolist())
    except MapError:
        return map_answers.UP


def ask_mapper(source: str, request: Request) -> dict[str, Any]:
    """The same of a running mapper.

    Raises:
        TransportError: nobody answers there.
        MapError, LabelError: a question that cannot be answered.
    """
    with MapClient(source, identity=request.remote.identity()) as client:
        match request.question:
            case Question.INFO:
                return map_answers.describe_map(client.mirror().snapshot())
            case Question.AT:
                return map_answers.answer_at(client.info().label_set, request.point, client.at([request.point]))
            case Question.NEAREST:
                hit = client.nearest(request.class_name, request.point, request.min_confidence)
                return map_answers.answer_nearest(request.class_name, request.point, hit)
            case Question.INSTANCES:
                up = request.up or map_answers.UP
                return map_answers.answer_instances(up, client.instances(up, gone=request.gone), map_answers.CONNECTED)
            case _:  # the graph
                return _answer_graph(source, client.graph(request.up), request.picture)


def _answer_graph(source: str, graph: SceneGraph, picture: Path | None) -> dict[str, Any]:
    """Also draws it.

    Raises:
        MapError: there is no floor to draw.
    """
    if picture is not None:
        if not graph.floors:
            raise MapError(f"{source}: there is nothing to draw: {map_answers.NO_FLOOR}")
        write_picture(picture, draw_graph(source, graph))
    return map_answers.answer_graph(graph)


def _arguments_of(question: Question, arguments: list[str]) -> list[str]:
    """As many as the question takes."""
    expected = ARGUMENTS.get(question, "").split()
    if len(arguments) != len(expected):
        raise typer.BadParameter(
            f"`{question.value}` takes {' '.join(expected) or 'nothing more'}, got {' '.join(arguments) or 'nothing'}"
        )
    return arguments


def _read_arguments(question: Question, arguments: list[str]) -> tuple[str, tuple[float, ...]]:
    """Class name and point, as far as the question has them."""
    arguments = _arguments_of(question, arguments)
    name = arguments[0] if question is Question.NEAREST else ""
    try:
        return name, tuple(float(a) for a in arguments[-3:])
    except ValueError as error:
        raise typer.BadParameter(f"X Y Z must be numbers, got {' '.join(arguments[-3:])}") from error


def _correct(
    endpoint: str, file: Path, camera: str, apply_until: float | None, remote: Remote, *, wait: bool, json: bool
) -> int:
    """Send corrected poses to a running mapper.

    Raises:
        ConfigError: it is a saved map.
        ImportSourceError: the poses cannot be read.
        MapError, TransportError: the mapper is not there, or refuses them.
    """
    output = Output.guarded()

    if "://" not in endpoint and Path(endpoint).exists():
        raise ConfigError(
            f"{endpoint}: is no running mapper; a saved map keeps no frames to correct, so map its log again with "
            f"`semantic-mapper replay LOG --corrections {file} --out FOLDER`"
        )
    trajectory = read_corrections(file)
    pairs = zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    poses = {(camera, stamp_ns): pose for stamp_ns, pose in pairs}
    until_ns = ALWAYS if apply_until is None else round(apply_until * 1e9)
    endpoint = map_endpoint(endpoint) or endpoint
    with MapClient(endpoint, identity=remote.identity()) as client:
        begun = client.correct_poses(poses, until_ns=until_ns, within_ns=MATCH_NS)
        state = _follow(client) if wait else begun
    outcome = {**asdict(state), "used": begun.used, "left_out": begun.left_out}
    if json:
        output.json(outcome)
    else:
        left_out = f"; {begun.left_out} have no frame in the history and were left out" if begun.left_out else ""
        output.print(f"{begun.used} corrected poses {_correction_text(state)}{left_out}")
    return EXIT_FAILED if state.failure else 0


def _relocalize(source: str, log: Path, every: int, max_frames: int, out: Path | None, *, json: bool) -> int:
    """Find the frames of a log in a saved map.

    Raises:
        ConfigError: it is a running mapper.
        LogError, MapError: see ``find_frames``.
    """
    output = Output.guarded()
    out, output.quiet = results_file(out), json
    if map_endpoint(source):
        raise ConfigError(
            f"{source}: is a running mapper, and frames are found in a saved map; `up --set map=FILE` goes on in one"
        )
    if out is not None:
        prepare_file(out)
    found = find_frames(Path(source), log, every, max_frames)
    if out is not None:
        write_json(out, found)
    if output.quiet:
        output.json(found)
    print_frames(found, output)
    if out is not None:
        output.print(f"written to {out}")
    return 0 if all_sessions_found(found) else EXIT_FAILED


def _follow(client: MapClient) -> Correction:
    """Wait until no correction is under way."""
    with frame_progress("correct", None) as bar:
        state = client.correction()
        bar.start(state.total)
        while state.running:
            bar.set(state.done, f"of {state.total}")  # frames that come meanwhile are added
            time.sleep(POLL_S)
            state = client.correction()
    return state


def _correction_text(state: Correction) -> str:
    if state.failure:
        return f"were given up, the map is as it was: {state.failure}"
    if state.running:
        return f"are being worked into the map: {state.done} of {state.total} frames"
    return "are in the map"
