"""``semantic-mapper mcp``: a map for agents."""

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.client import MapClient
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.agents import MapNow, read_live, serve
from semantic_mapper.nodes.cli.verb import Remote, complete_launch, must_be_there, refuse_options, verb
from semantic_mapper.queries.find import open_objects
from semantic_mapper.queries.objects import ObjectMemory, changes_between
from semantic_mapper.queries.questions import RememberedObjects
from semantic_mapper.queries.surface import up_in
from semantic_mapper.replay.run_folder import map_path
from semantic_mapper.transport.launches import is_running_mapper


@verb
def mcp(
    # saved map, folder of results, `live`, ipc://PATH or tcp://HOST:PORT
    source: Annotated[str, typer.Argument(metavar="MAP", autocompletion=complete_launch)],
    remote: Remote,
    *,
    since: Path | None = None,  # saved map: map of before, for what_changed [what it remembers itself]
) -> None:
    """Serve a map to an agent by the Model Context Protocol, on stdin and stdout.

    Tools: find, goal_near, what_changed, describe_room, look. They only read.

    Example: semantic-mapper mcp runs/demo
    Example: semantic-mapper mcp live
    """
    live = is_running_mapper(source)
    remote.refuse_unless(live)
    refuse_options((since is not None and live, "--since", "goes with a saved map"))
    if live:
        with MapClient(source, server=remote.server, keys=remote.keys) as client:
            serve(lambda: read_live(client))
        return
    paths = [Path(source), *([] if since is None else [since])]
    must_be_there(*paths)
    snapshot, objects = open_objects(map_path(paths[0]))
    if since is None:
        known = RememberedObjects.of_saved(objects)
        since_ns, changes = known.since_ns, known.changes
    else:
        voxel_map, before = (VoxelMap.load(map_path(path)) for path in paths)
        changes, before = changes_between(voxel_map, before)
        since_ns = before.last_stamp_ns
        objects = ObjectMemory.from_bytes(voxel_map.objects).objects  # with the ids of the changes
    now = MapNow(snapshot, objects, up_in(snapshot), since_ns, changes)
    serve(lambda: now)
