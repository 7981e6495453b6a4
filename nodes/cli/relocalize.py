"""``semantic-mapper relocalize``: where the frames of a log are in a saved map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.relocalize import relocalize_frames
from semantic_mapper.replay.run_folder import map_path

_NAMED = 10  # frames that cannot be read


@verb
def relocalize(
    saved: Annotated[Path, typer.Argument(metavar="MAP", help="Saved map, or a folder of results with one.")],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Frames with measured depth.")],
    every: Annotated[int, typer.Option(min=1, help="Look for every n-th frame.")] = 1,
    max_frames: Annotated[int, typer.Option("--max-frames", min=0, help="Of those; 0 = all.")] = 0,
    json: Annotated[
        bool, typer.Option("--json", help="Print every frame as JSON, and nothing else, on stdout.")
    ] = False,
) -> int:
    """Find the frames of a log in a map, each by itself; their poses are used only to see whether they agree.

    A frame is found where features, depth and brightness agree with the map. Exit code 1 where it is not known
    where a world of the log lies: three frames, and most of those that are found, have to agree on it.

    Example: semantic-mapper relocalize runs/yesterday today.mcap
    """
    output = Output.guarded()

    map_file = map_path(saved)
    must_be_there(log)

    voxel_map = VoxelMap.load(map_file)
    if not len(voxel_map.places):
        raise MapError(
            f"{saved}: has nothing to find oneself by: it was made without depth, by an older release, or with "
            "keyframes.save_places = false; map its log again"
        )
    with open_log((log,)) as frames:
        count = -(-len(frames) // every)
        count = min(count, max_frames or count)
        with frame_progress("relocalize", None) as bar:
            bar.start(count)
            found = relocalize_frames(voxel_map, frames, every, count, bar.set)
    if json:
        output.json(found)
    else:
        _print(found, output)
    sessions = found["sessions"]
    return 0 if sessions and all(session["T_map_world"] is not None for session in sessions) else EXIT_FAILED


def _print(found: dict[str, Any], output: Output) -> None:
    output.print(f"{found['found']} of {found['frames']} frames found")
    for reason, times in found["refused"].items():
        output.print(f"  {times} not: {reason}")
    if found["unreadable"]:
        output.print(f"{len(found['unreadable'])} more cannot be read:")
    for frame in found["unreadable"][:_NAMED]:
        output.print(f"  frame {frame['number']}: {frame['reason']}")
    for session in found["sessions"]:
        name = f"world {session['world']} of the log" if len(found["sessions"]) > 1 else "the log's world"
        if session["disagreement"]:
            output.print(f"where {name} lies in the map is not known: {session['disagreement']}")
            continue
        output.print(f"{name} in the map, on which {session['agreeing']} of {session['found']} agree, T_map_world:")
        for row in session["T_map_world"]:
            output.print("  " + " ".join(f"{value:9.4f}" for value in row))
