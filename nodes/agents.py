"""A map for agents: tools that read it, by the Model Context Protocol over stdin and stdout."""

import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from semantic_mapper.client import MapClient
from semantic_mapper.errors import DependencyError, MapError, SemanticMapperError
from semantic_mapper.geometry import look_at
from semantic_mapper.nodes import map_answers
from semantic_mapper.plots import encode_picture
from semantic_mapper.queries.find import EYE_M, LIKELY, FoundObject, find, picture_of, render, room_kinds
from semantic_mapper.queries.objects import MapObject, ObjectChange
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float64, UInt8

WIDTH = 640  # of pictures
INSTRUCTIONS = """What a robot knows of the place that it maps. Lengths are metres in the world of the map, stamps are
nanoseconds, probabilities are from 0 to 1. Phrases name a thing of the map's classes or a synonym, with colour, size,
room ("in room 2", "in the kitchen"), relation (near, on, under, above, in) and time ("last seen before noon"): "the red
chair near the table". A word that is not known is an error that names the nearest. Begin with describe_room without a
name. What was never seen is not in the map, and a thing that was moved unseen is still where it was seen."""


class MapNow(NamedTuple):
    """A map and what it remembers, at one time."""

    snapshot: MapSnapshot
    objects: tuple[MapObject, ...]
    up: Float64  # (3,) unit vector
    since_ns: int | None  # after which there are changes; None = there is no map of before
    changes: tuple[ObjectChange, ...]


def read_live(client: MapClient) -> MapNow:
    """The map of a running mapper. Raises as ``MapClient.objects`` does."""
    known, up = client.objects(), client.up()
    return MapNow(client.mirror().snapshot(), known.objects, up, known.since_ns or None, known.changes)


class MapTools:
    """The tools: public methods, with docstrings for agents. All raise MapError: as of ``find``, or nothing fits."""

    def __init__(self, read: Callable[[], MapNow]) -> None:
        self._read = read

    def find(self, phrase: str, limit: int = 5) -> dict[str, Any]:
        """Things that a phrase means, the likeliest first: class, probability and its parts, place (box), room, when it
        was last seen, and T_world_camera, a pose over free floor to look at it from (z forward, y down)."""
        now = self._read()
        return map_answers.answer_find(phrase, find(phrase, now.snapshot, now.objects, up=now.up, limit=limit))

    def goal_near(self, phrase: str) -> dict[str, Any]:
        """Where a robot can stand to look at the likeliest thing that a phrase means: position on free floor and the
        level direction to face, in the world."""
        now = self._read()
        found = _answers(now, phrase)
        likely = (a for a in found if a.probability >= LIKELY * found[0].probability)
        answer = next((a for a in likely if a.T_world_camera is not None), None)
        if answer is None or (T := answer.T_world_camera) is None:
            raise MapError(f"no place from which '{phrase}' is seen is known; `find` says where the likeliest thing is")
        level = T[:3, 2] - (T[:3, 2] @ now.up) * now.up
        position, forward = T[:3, 3] - EYE_M * now.up, level / np.linalg.norm(level)
        goal = {"position": np.round(position, 3).tolist(), "forward": np.round(forward, 3).tolist()}
        return {**goal, "thing": map_answers.answer_find(phrase, [answer])["answers"][0]}

    def what_changed(self) -> dict[str, Any]:
        """What was moved, is new, or has gone since the map of before, the surest first."""
        now = self._read()
        return map_answers.answer_changes(now.since_ns, now.changes)

    def describe_room(self, room: str = "") -> dict[str, Any]:
        """All rooms with their likeliest kinds and counts of things; or the things of one, by id ("2") or kind
        ("kitchen"). Kinds are judged by what stands there."""
        objects = [o for o in self._read().objects if o.gone_ns is None]
        kinds = room_kinds(objects)
        wanted = room.casefold().removeprefix("the ").removeprefix("room").strip()
        if not wanted:
            return {"rooms": [_room(number, kinds[number], objects) for number in sorted(kinds)]}
        by_id = wanted.isdecimal() and len(wanted) < 10
        number = int(wanted) if by_id else max(kinds, key=lambda n: kinds[n].get(wanted, 0), default=0)
        likeliest = {n: max(kind, key=kind.__getitem__) for n, kind in sorted(kinds.items())}
        if number not in kinds or not (by_id or likeliest[number] == wanted):
            names = [f"{n} ({kind or 'of no kind'})" for n, kind in likeliest.items()]
            raise MapError(f"no room '{room}' is known; rooms are {', '.join(names) or 'not known at all'}")
        things = [
            {
                "id": o.id,
                "class": o.class_name,
                "probability": round(o.probability, 3),
                "center": o.box.center.round(3).tolist(),
                "size": o.box.size.round(3).tolist(),
                "rgb": o.color.tolist(),
            }
            for o in objects
            if o.room == number
        ]
        return {**_room(number, kinds[number], objects), "things": things}

    def look(self, phrase: str = "", eye: list[float] | None = None, target: list[float] | None = None) -> UInt8:
        """A picture rendered from the map: of the likeliest thing that a phrase means, or from eye [x, y, z] to target
        [x, y, z]. Light grey is where nothing was mapped."""
        now = self._read()
        if phrase:
            return picture_of(now.snapshot, _answers(now, phrase)[0], now.up, WIDTH)
        places = [np.array(p or (), np.float64) for p in (eye, target)]
        if any(p.shape != (3,) for p in places):
            raise MapError("look: give a phrase, or eye and target, [x, y, z] each")
        forward = places[1] - places[0]
        along_up = np.linalg.norm(np.cross(forward, now.up)) <= 1e-3 * np.linalg.norm(forward)
        up = np.eye(3)[np.abs(now.up).argmin()] if along_up else now.up  # from above: any side
        return render(now.snapshot, look_at(places[0], places[1], up), WIDTH)


def serve(read: Callable[[], MapNow]) -> None:
    """Answer an agent on stdin and stdout until it closes them. Raises DependencyError: the extra is not installed."""
    try:
        from mcp.server.mcpserver import Image, MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
        from mcp.types import ToolAnnotations
    except ModuleNotFoundError as error:
        raise DependencyError("`mcp` needs the package mcp: pip install 'semantic-mapper[mcp]'") from error

    def as_tool(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def tool(*args: Any, **kwargs: Any) -> Any:
            try:
                return method(*args, **kwargs)
            except SemanticMapperError as error:
                raise ToolError(str(error)) from error

        return tool

    tools = MapTools(read)

    def look(phrase: str = "", eye: list[float] | None = None, target: list[float] | None = None) -> Image:
        return Image(data=encode_picture(tools.look(phrase, eye, target)), format="png")

    look.__doc__ = tools.look.__doc__
    server = MCPServer("semantic-mapper", instructions=INSTRUCTIONS, log_level="WARNING")
    for method in (tools.find, tools.goal_near, tools.what_changed, tools.describe_room, look):
        server.add_tool(as_tool(method), annotations=ToolAnnotations(read_only_hint=True), structured_output=False)
    server.run("stdio")


def _answers(now: MapNow, phrase: str) -> Sequence[FoundObject]:
    found = find(phrase, now.snapshot, now.objects, up=now.up)
    if not found:
        classes = sorted({o.class_name for o in now.objects if o.gone_ns is None})
        raise MapError(f"nothing in the map fits '{phrase}'; there are things of the classes {', '.join(classes)}")
    return found


def _room(number: int, kinds: dict[str, float], objects: Sequence[MapObject]) -> dict[str, Any]:
    kind = max(kinds, key=kinds.__getitem__)
    counts = Counter(o.class_name for o in objects if o.room == number)
    return {"id": number, "kind": kind or None, "probability": round(kinds[kind], 3), "counts": dict(counts)}
