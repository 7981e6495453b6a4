"""``semantic-mapper query MAP relocalize LOG``: where the frames of a log are in a saved map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.verb import must_be_there
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.relocalize import relocalize_frames
from semantic_mapper.replay.run_folder import map_path

_NAMED = 10  # frames that cannot be read


def find_frames(saved: Path, log: Path, every: int, max_frames: int) -> dict[str, Any]:
    """Look for the frames of a log in a saved map; plain data, as ``replay.relocalize`` gives it.

    Args:
        saved: The map, or a folder of results with one.
        log: Its frames have measured depth.
        every: Look for every n-th frame.
        max_frames: Of those; 0 = all.

    Raises:
        ConfigError, LogError: no map or no log there.
        MapError: the map has nothing to be found by.
    """
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
            return relocalize_frames(voxel_map, frames, every, count, bar.set)


def all_sessions_found(found: dict[str, Any]) -> bool:
    """Whether it is known where each session of the log lies."""
    return bool(found["sessions"]) and all(session["T_map_world"] is not None for session in found["sessions"])


def print_frames(found: dict[str, Any], output: Output) -> None:
    """The answer, for people."""
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
