"""``semantic-mapper query``: ask a saved map, or that of a running mapper."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.table import Table

from semantic_mapper.client import UP, MapClient
from semantic_mapper.config import AtLeastOne, Fraction, nearest_path
from semantic_mapper.errors import ConfigError, MapError, TransportError
from semantic_mapper.labels import PLAIN_NAMES
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.map_file import open_map
from semantic_mapper.mapping.map_types import length_unit
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes import map_answers
from semantic_mapper.nodes.cli.verb import (
    EXIT_FAILED,
    JsonOutput,
    Remote,
    UpOption,
    complete_launch,
    must_be_there,
    refuse_options,
    verb,
    wrong_usage,
)
from semantic_mapper.nodes.console import Output, frame_progress, table
from semantic_mapper.plain_text import counted
from semantic_mapper.plots import write_picture
from semantic_mapper.queries.find import find, open_objects, picture_of
from semantic_mapper.queries.graph import GraphTracker, draw_graph
from semantic_mapper.queries.instances import Instance, InstanceTracker
from semantic_mapper.queries.nearest import MAX_RADIUS_VOXELS, at, nearest
from semantic_mapper.queries.objects import ObjectMemory, changes_between
from semantic_mapper.queries.phrase import has_date
from semantic_mapper.queries.questions import RememberedObjects
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import up_in
from semantic_mapper.replay.changes_picture import draw_changes
from semantic_mapper.replay.exporters.map_files import parse_up
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.relocalize import relocalize_frames
from semantic_mapper.replay.run_folder import map_path, prepare_file, prepare_folder
from semantic_mapper.transport.launches import is_running_mapper, launch_folder, running_launches
from semantic_mapper.transport.messages import SCALE_UNKNOWN

_log = get_logger(__name__)
Up = tuple[float, float, float]
Things = tuple[Instance, ...]
Question = Literal["info", "at", "nearest", "instances", "graph", "changes", "find", "relocalize"]
ARGUMENTS: Mapping[str, str] = {"at": "X Y Z", "nearest": "CLASS X Y Z", "find": "PHRASE", "relocalize": "LOG"}


@verb
def query(
    output: JsonOutput,
    # saved map, folder of results, `live`, ipc://PATH or tcp://HOST:PORT
    source: Annotated[str, typer.Argument(metavar="MAP", autocompletion=complete_launch)],
    question: Question,
    remote: Remote,
    arguments: Annotated[list[str] | None, typer.Argument(metavar="[ABOUT]")] = None,
    *,
    up: UpOption = "auto",
    min_confidence: Fraction = 0.0,  # nearest: of the class, at least
    gone: bool = False,  # instances, running mapper: gone ones, too
    unsure: bool = False,  # nearest, instances: also below the least certainty
    picture: Path | None = None,  # graph, changes of saved maps: drawn too (.png)
    since: Path | None = None,  # changes of a saved map: the one before
    pictures: Path | None = None,  # find: folder for a picture of each answer
    every: AtLeastOne = 1,  # relocalize: every n-th frame
) -> int:
    """Ask a saved map, or a running mapper, what is where.

    info: size and classes. at X Y Z: class at a point, whose box it is in, and whether it is free, occupied or
    unknown. nearest CLASS X Y Z: the nearest surface of a class, and its thing. instances: countable things with
    upright boxes, certainty and the fraction seen. graph: floors, rooms, doors, and things by room. changes: what was
    moved, is new or has gone since another map. find PHRASE: remembered things by class, colour, size, room (`in room
    2`, `in the kitchen`), relation (near, on, under, above, in) and time. relocalize LOG: find frames with measured
    depth in a saved map; exit code 1 where they do not agree.

    Example: semantic-mapper query runs/demo/map.npz nearest chair 0 0 1
    Example: semantic-mapper query runs/today changes --since runs/yesterday
    Example: semantic-mapper query live find "red chair near the table"
    Example: semantic-mapper query tcp://robot:5570 info --server robot
    """
    name, point = _read_arguments(question, arguments or [])
    with wrong_usage():
        direction, live = parse_up(up), is_running_mapper(source)
    remote.refuse_unless(live)
    axis: Up | None = None if direction is None else tuple(direction.tolist())
    refuse_options(
        (gone and not (live and question == "instances"), "--gone", "goes with `instances` of a running mapper"),
        (unsure and question not in ("nearest", "instances"), "--unsure", "goes with `nearest` and `instances`"),
        (
            picture is not None and (question not in ("graph", "changes") or (question == "changes" and live)),
            "--picture",
            "goes with `graph`, and with `changes` of a saved map",
        ),
        (pictures is not None and question != "find", "--pictures", "goes with `find`"),
        (since is not None and (live or question != "changes"), "--since", "goes with `changes` of a saved map"),
    )
    if picture is not None:
        prepare_file(picture)
    if pictures is not None:
        prepare_folder(pictures)
    code = 0
    if question == "relocalize":
        found = _relocalize(output, source, Path(name), every, live=live)
        located = [session["T_map_world"] is not None for session in found["sessions"]]
        code = 0 if located and all(located) else EXIT_FAILED
    elif question == "find":
        found = {"map": source, **_find(source, name, axis, pictures, remote, live=live)}
        output.print(answer_table(found))
    elif question == "changes" and not live:
        found = {"map": source, **_saved_changes(source, since, picture, axis)}
        output.print(answer_table(found))
    else:
        client = MapClient(source, server=remote.server, keys=remote.keys) if live else nullcontext(open_saved(source))
        with client as world_map:
            values = (question, name, point, axis, min_confidence, gone, unsure, picture)
            found = {"map": source, **answer(world_map, *values)}
            if question == "graph":
                memory = _saved_memory(source) if isinstance(world_map, MapSnapshot) else world_map.objects(axis)
                found["remembered"] = map_answers.describe_memory(memory)
        output.print(answer_table(found))
        if found.get("found") is False and not unsure:
            output.print("nothing is certain enough to be listed; --unsure lists all candidates")
    output.json(found)
    if picture is not None:
        if question == "graph" and not found["floors"]:
            raise MapError(f"{picture} is not drawn: {map_answers.NO_FLOOR}")
        output.print(f"written to {picture}")
    return code


def open_saved(source: str) -> MapSnapshot:
    """A map file, or that of a folder of results."""
    path = Path(source)
    if not path.exists() and running_launches():
        try:
            launch_folder(source)  # names those that run
        except TransportError as error:
            raise ConfigError(f"{path}: no such map file or folder{nearest_path(path)}; {error}") from error
    return MapMirror.load(map_path(path)).snapshot()


def answer(
    world_map: MapClient | MapSnapshot,
    question: Question,
    class_name: str = "",
    point: tuple[float, ...] = (),
    up: Up | None = None,
    min_confidence: float = 0.0,
    gone: bool = False,
    unsure: bool = False,
    picture: Path | None = None,
) -> dict[str, Any]:
    """The answer of a running mapper or of a saved map, as plain data; the arguments are those of ``query``."""
    saved = isinstance(world_map, MapSnapshot)
    match question:
        case "info":
            return map_answers.describe_map(world_map if saved else world_map.mirror().snapshot())
        case "at":
            about = world_map if saved else world_map.info()
            things = _instances(world_map, _axis(world_map, up)) if about.scale_known else ()
            ask = partial(at, world_map) if saved else world_map.at
            found, far_m = ask([point]), MAX_RADIUS_VOXELS * about.voxel_size_m
            if np.isinf(found.distance_m[0]):  # the class of what is so far away is not the one here
                found = replace(found, distance_m=ask([point], far_m).distance_m, measured=None)
            return map_answers.answer_at(about.label_set, point, found, things)
        case "nearest":
            ask = partial(nearest, world_map) if saved else world_map.nearest
            hit = ask(class_name, point, min_confidence, unsure=unsure, up=_axis(world_map, up))
            return map_answers.answer_nearest(class_name, point, hit)
        case "instances":
            axis = _axis(world_map, up)
            return map_answers.answer_instances(axis, _instances(world_map, axis, gone, unsure))
        case "changes":
            assert not saved  # see ``_saved_changes``
            remembered = world_map.objects(up)
            return map_answers.answer_changes(remembered.since_ns or None, remembered.changes)
        case _:  # the graph
            graph = GraphTracker(up).update(world_map) if saved else world_map.graph(up)
            if picture is not None and graph.floors:
                write_picture(picture, draw_graph("rooms, doors and objects", graph))
            return map_answers.answer_graph(graph)


def _saved_changes(source: str, since: Path | None, picture: Path | None, up: Up | None) -> dict[str, Any]:
    """What has changed between two saved maps, and a picture of it."""
    if since is None:
        raise ConfigError("`changes` of a saved map needs the map of before: --since MAP")
    must_be_there(Path(source), since)
    before, now = (VoxelMap.load(map_path(path)) for path in (since, Path(source)))
    changes, before = changes_between(now, before, up)
    if picture is not None:
        axis = up_in(MapMirror.of(now).snapshot()) if up is None else np.array(up)
        title = f"{since} and {source}"
        write_picture(picture, draw_changes(before.points(), now.points(), changes, axis, title=title))
    return map_answers.answer_changes(before.last_stamp_ns, changes)


def _saved_memory(source: str) -> RememberedObjects:
    with open_map(map_path(Path(source))) as reader:
        return RememberedObjects.of_saved(ObjectMemory.from_bytes(reader.objects()).objects)


def _find(
    source: str, phrase: str, up: Up | None, pictures: Path | None, remote: Remote, *, live: bool
) -> dict[str, Any]:
    """What a phrase means, in a saved map or that of a running mapper, with a picture of each answer."""
    if live:
        with MapClient(source, server=remote.server, keys=remote.keys) as client:
            answers = client.find(phrase, up=up)
            snapshot = None if pictures is None else client.mirror().snapshot()
    else:
        must_be_there(Path(source))
        snapshot, objects = open_objects(map_path(Path(source)), up)
        answers = find(phrase, snapshot, objects, up=up)
    found = map_answers.answer_find(phrase, answers)
    for old in () if pictures is None else pictures.glob("[0-9]_object_[0-9]*.png"):
        old.unlink()  # of an earlier answer
    if pictures is None or snapshot is None or not answers:
        return found
    axis = np.array(up_in(snapshot) if up is None else up)
    for number, answer in enumerate(answers, start=1):
        path = pictures / f"{number}_object_{answer.object.id}.png"
        write_picture(path, picture_of(snapshot, answer, axis))
        found["answers"][number - 1]["picture"] = str(path)
    return found


def _axis(world_map: MapClient | MapSnapshot, up: Up | None) -> Up:
    """As given; else of a saved map away from the floor, as in the graph; else z of the world."""
    if up is not None or not isinstance(world_map, MapSnapshot):
        return up or UP
    try:
        return tuple(up_in(world_map).tolist())
    except MapError as error:
        _log.warning("boxes_stand_along_z", reason=str(error))
        return UP


def _instances(world_map: MapClient | MapSnapshot, up: Up, gone: bool = False, unsure: bool = False) -> Things:
    if isinstance(world_map, MapSnapshot):
        return InstanceTracker(up=up).update(world_map, unsure=unsure)
    return world_map.instances(up, gone=gone, unsure=unsure)


def _read_arguments(question: Question, arguments: list[str]) -> tuple[str, tuple[float, ...]]:
    """Class name or file, and point, as far as the question has them."""
    expected = ARGUMENTS.get(question, "").split()
    if question == "find" and arguments:
        return " ".join(arguments), ()
    if len(arguments) != len(expected):
        raise typer.BadParameter(
            f"`{question}` takes {' '.join(expected) or 'nothing more'}, got {' '.join(arguments) or 'nothing'}"
        )
    name = arguments.pop(0) if expected and expected[0] != "X" else ""
    try:
        return name, tuple(float(a) for a in arguments)
    except ValueError as error:
        raise typer.BadParameter(f"X Y Z must be numbers, got {' '.join(arguments)}") from error


def _relocalize(output: Output, source: str, log: Path, every: int, *, live: bool) -> dict[str, Any]:
    if live:
        raise ConfigError(
            f"{source}: is a running mapper; frames are found in a saved map (`up --set mapper.map=FILE` goes on there)"
        )
    must_be_there(log)
    voxel_map = VoxelMap.load(map_path(Path(source)))
    if not len(voxel_map.places):
        raise MapError(
            f"{source}: has nothing to find oneself by: it was made without depth, or with keyframes.save_places = "
            "false; map its log again"
        )
    with open_log((log,)) as frames, frame_progress("relocalize", None) as bar:
        count = -(-len(frames) // every)
        bar.start(count)
        found = relocalize_frames(voxel_map, frames, every, count, bar.set)
    output.print(f"{found['found']} of {found['frames']} frames found")
    output.lines([f"  {times} not: {reason}" for reason, times in found["refused"].items()])
    output.lines([f"  frame {frame['number']} cannot be read: {frame['reason']}" for frame in found["unreadable"]])
    for session in found["sessions"]:
        name = f"world {session['world']} of the log" if len(found["sessions"]) > 1 else "the log's world"
        if session["disagreement"]:
            output.print(f"where {name} lies in the map is not known: {session['disagreement']}")
            continue
        output.print(f"{name} in the map, on which {session['agreeing']} of {session['found']} agree, T_map_world:")
        for row in session["T_map_world"]:
            output.print("  " + " ".join(f"{value:9.4f}" for value in row))
    return found


def answer_table(found: dict[str, Any]) -> Table:
    """An answer with the ``map`` that it is of, for people."""
    if found["question"] == "instances":
        return _instance_table(found)
    if found["question"] == "graph":
        return _graph_table(found)
    if found["question"] == "changes":
        return _change_table(found)
    if found["question"] == "find":
        return _find_table(found)
    unit = length_unit(found.get("scale") != SCALE_UNKNOWN)
    plain = {key: value for key, value in found.items() if not isinstance(value, dict)} | _in_words(found)
    plain |= {key: f"{_joined(value)} {unit}" for key, value in plain.items() if isinstance(value, list)}
    rows = [(key.replace("_", " "), "none" if value is None else str(value)) for key, value in plain.items()]
    classes = sorted(found.get("classes", {}).items(), key=lambda item: -item[1])
    rows += [(name, counted(count, "surface voxel")) for name, count in classes if count]
    return table(rows, title=found["map"])


def _in_words(found: dict[str, Any]) -> dict[str, Any]:
    """Of ``at`` and ``nearest``, what names things or needs a word more."""
    words: dict[str, Any] = {}
    if "inside" in found:
        words["inside"] = ", ".join(f"the box of {_title(thing)}" for thing in found["inside"]) or "no box of a thing"
        if found["surface_distance_m"] is None:
            words["surface_distance_m"] = f"none within {MAX_RADIUS_VOXELS:.0f} voxels"
        if found["state"] == "unknown":
            words["state"] = "unknown: not seen"
    if thing := found.get("thing"):
        words |= {"thing": _title(thing), "center": thing["box"]["center"], "box": thing["box"]["size"]}
        words |= {key: f"{thing[key] * 100:.0f} %" for key in ("certainty", "seen")}
    elif "thing" in found:
        words["thing"] = "none: surface alone"
    return words


def _title(thing: dict[str, Any]) -> str:
    return f"{PLAIN_NAMES.get(thing['class'], thing['class'])} {thing['id']}"


def _instance_table(found: dict[str, Any]) -> Table:
    things = [*found["instances"], *found.get("gone", ())]
    rows = [
        (
            *(thing["id"], thing["class"], *(f"{thing[key] * 100:.0f} %" for key in ("certainty", "seen", "measured"))),
            *(_joined(thing["centroid"]), _joined(thing["box"]["size"])),
            f"{thing['gone_ns'] / 1e9:.2f}" if "gone_ns" in thing else "",
        )
        for thing in things
    ]
    names = ("id", "class", "certainty", "seen", "measured", "centroid, m", "box, m", "gone at, s")
    return table(rows, names, title=found["map"], caption=_plain_names(things))


def _graph_table(found: dict[str, Any]) -> Table:
    def objects(room: int | None) -> str:
        counts = Counter(thing["class"] for thing in found["objects"] if thing["room"] == room)
        return ", ".join(name if count == 1 else f"{count} {name}" for name, count in sorted(counts.items()))

    rows: list[tuple[object, ...]] = [
        (r["id"], r["floor"], f"{r['area_m2']:.1f}", " ".join(map(str, r["neighbours"])), objects(r["id"]))
        for r in found["rooms"]
    ]
    rows += [("none", "", "", "", objects(None))] if objects(None) else []
    names = ("room", "floor", "area, m2", "doors to", "objects")
    caption = _plain_names(found["objects"]) if found["floors"] else map_answers.NO_FLOOR
    return table(rows, names, title=found["map"], caption=caption)


def _change_table(found: dict[str, Any]) -> Table:
    def place(where: dict[str, Any] | None) -> tuple[object, str]:
        return ("", "") if where is None else (where["room"] or "", _joined(where["box"]["center"]))

    rows = [
        (c["kind"], c["id"], c["class"], f"{c['probability'] * 100:.0f} %", *place(c["before"]), *place(c["now"]))
        for c in found["changes"]
    ]
    names = ("", "object", "class", "probability", "room before", "center before, m", "room", "center, m")
    caption = _plain_names(found["changes"]) if rows else "nothing has changed of what both maps have seen"
    return table(rows, names, title=found["map"], caption=caption)


def _find_table(found: dict[str, Any]) -> Table:
    def seen(stamp_ns: int) -> str:
        return f"{datetime.fromtimestamp(stamp_ns / 1e9):%F %R}" if has_date(stamp_ns) else f"{stamp_ns / 1e9:.1f} s"

    rows = [
        (
            *(a["id"], a["class"], f"{a['probability'] * 100:.0f} %", f"{a['room'] or ''} {a['room_kind'] or ''}"),
            *(_joined(a["box"]["center"]), seen(a["last_seen_ns"]) + (", gone" if a["gone_ns"] else "")),
            "" if a["T_world_camera"] is None else _joined([row[3] for row in a["T_world_camera"][:3]]),
        )
        for a in found["answers"]
    ]
    names = ("object", "class", "probability", "room", "center, m", "last seen", "look from, m")
    notes = (found.get("note", ""), _plain_names(found["answers"])) if rows else ("nothing in the map fits all of it",)
    caption = "; ".join(filter(None, notes))
    return table(rows, names, title=f"{found['map']}: {found['phrase']}", caption=caption)


def _plain_names(things: Sequence[dict[str, Any]]) -> str:
    """What classes are in plain words, where the name does not say it."""
    return ", ".join(f"{name}: {PLAIN_NAMES[name]}" for name in sorted({t["class"] for t in things} & set(PLAIN_NAMES)))


def _joined(xyz: list[float]) -> str:
    return " ".join(f"{x:.2f}" for x in xyz)
