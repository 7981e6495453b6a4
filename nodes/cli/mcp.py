"""``semantic-mapper mcp``: a map for agents."""

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.client import MapClient
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.agents import MapNow, read_live, serve
from semantic_mapper.nodes.cli.verb import (
    Remote,
    UpOption,
    complete_launch,
    must_be_there,
    refuse_options,
    verb,
    wrong_usage,
)
from semantic_mapper.queries.find import open_objects
from semantic_mapper.queries.objects import brought_up, changes_between
from semantic_mapper.queries.questions import RememberedObjects
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.queries.surface import up_in
from semantic_mapper.replay.exporters.map_files import parse_up
from semantic_mapper.replay.run_folder import map_path
from semantic_mapper.transport.launches import is_running_mapper


@verb
def mcp(
    # saved map, folder of results, `live`, ipc://PATH or tcp://HOST:PORT
    source: Annotated[str, typer.Argument(metavar="MAP", autocompletion=complete_launch)],
    remote: Remote,
    *,
    up: UpOption = "auto",  # saved map
    since: Path | None = None,  # saved map: map of before, for what_changed [what it remembers itself]
) -> None:
    """Serve a map to an agent by the Model Context Protocol, on stdin and stdout.

    Tools: find, goal_near, what_changed, describe_room, look. They only read.

    Example: semantic-mapper mcp runs/demo
    Example: semantic-mapper mcp live
    """
    with wrong_usage():
        direction, live = parse_up(up), is_running_mapper(source)
    remote.refuse_unless(live)
    refuse_options(
        (since is not None and live, "--since", "goes with a saved map"),
        (direction is not None and live, "--up", "goes with a saved map"),
    )
    if live:
        with MapClient(source, server=remote.server, keys=remote.keys) as client:
            serve(lambda: read_live(client))
        return
    paths = [Path(source), *([] if since is None else [since])]
    must_be_there(*paths)
    if since is None:
        snapshot, objects = open_objects(map_path(paths[0]), direction)
        known = RememberedObjects.of_saved(objects)
        since_ns, changes = known.since_ns or None, known.changes
    else:
        voxel_map, before = (VoxelMap.load(map_path(path)) for path in paths)
        changes, before = changes_between(voxel_map, before, direction)
        since_ns, snapshot = before.last_stamp_ns, MapMirror.of(voxel_map).snapshot()
        memory = brought_up(voxel_map, direction)  # with the ids of the changes
        objects = () if memory is None else memory.objects
    now = MapNow(snapshot, objects, up_in(snapshot) if direction is None else direction, since_ns, changes)
    serve(lambda: now)
