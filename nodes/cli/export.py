"""The verbs ``export`` (of maps and logs) and ``merge``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.client import MapClient
from semantic_mapper.config import Fraction, NotNegative
from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.fusion import SURFACE_WEIGHT
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.verb import JsonOutput, Remote, UpOption, complete_launch, verb, wrong_usage
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.fleet.merge import find_maps, merge_maps, read_poses
from semantic_mapper.nodes.fleet.store import is_url
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.exporters import export_log, log_format_of
from semantic_mapper.replay.exporters.map_files import ExportRequest, Format, export_map, format_of, parse_up
from semantic_mapper.replay.exporters.run import LogFormat
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import is_log, map_path, prepare_file, prepare_folder, refuse_overwriting
from semantic_mapper.transport.launches import is_running_mapper

Pair = tuple[float, float]


@verb
def export(
    output: Output,
    # saved map, log, folder with one, or running mapper: `live`, launch, ipc://PATH, tcp://HOST:PORT
    source: Annotated[str, typer.Argument(metavar="MAP|LOG", autocompletion=complete_launch)],
    remote: Remote,
    *,
    out: Path,  # file to write; its ending is the format
    # where the ending does not say it
    format_: Literal[Format, LogFormat] | None = None,
    color: Literal["rgb", "class", "confidence"] | None = None,  # of points and meshes; rgb without it
    min_weight: float = SURFACE_WEIGHT,  # leave out voxels seen less
    min_confidence: Fraction = 0.0,  # leave out surface of less sure class
    up: UpOption = "auto",
    # grid: obstacles, above the floor [0.1 1.8]
    height: Annotated[Pair | None, typer.Option(metavar="LOW HIGH")] = None,
    resolution: float | None = None,  # grid: side of a cell, metres [0.05]
    floor: float | None = None,  # grid: height of the floor [found]
    costs: Path | None = None,  # grid: TOML of costs, lines `person = 100`
    camera: str = "",  # logs: the frames of this camera only
    max_frames: NotNegative = 0,  # logs: stop after this many; 0 = all
) -> None:
    """Write a map, or a log, in a format of other programs.

    Maps: .ply points (--format ply-mesh: a mesh), .glb mesh, .rrd for Rerun, .yaml or .pgm floor plan for
    nav2 (free only where the floor was seen; --costs: 0 to 100, mode raw, unknown 255). A running mapper gives less
    than its saved map: the likeliest class of a voxel; weight 1, or below for computed depth. Logs: .mcap for Foxglove,
    .txt trajectory (TUM), folder that `import` reads again without loss, --format tum or lerobot.

    Example: semantic-mapper export runs/kitchen --out kitchen.glb --color class
    Example: semantic-mapper export runs/kitchen --out plan.yaml --height 0.1 1.2
    Example: semantic-mapper export live --out now.ply
    """
    map_options = (color, height, resolution, floor, costs, up, min_weight, min_confidence)
    path, live = Path(source), is_running_mapper(source)
    remote.refuse_unless(live)
    if not live and is_log(path):
        if map_options != (None, None, None, None, None, "auto", SURFACE_WEIGHT, 0.0):
            raise ConfigError(f"{source}: is a log; only --format, --camera and --max-frames are for logs")
        export_recording(output, path, out, log_format_of(out, format_), camera, max_frames)
        return
    if camera or max_frames:
        raise ConfigError("--camera and --max-frames are for logs; a map has no frames")
    of_grid = (height, resolution, floor, costs)
    with wrong_usage():
        request = ExportRequest(format_of(out, format_), min_weight, min_confidence, color, parse_up(up), *of_grid)
    if not live:
        path = map_path(path)
        refuse_overwriting(out, path)
    prepare_file(out)
    if live:
        with MapClient(source, server=remote.server, keys=remote.keys) as client:
            seen = client.mirror().snapshot()
        world_map = VoxelMap.received(seen.changes(0), seen.voxel_size_m, seen.label_set)
    else:
        world_map = VoxelMap.load(path)
    report = export_map(world_map, out, request)
    output.print(f"{' and '.join(map(str, report.files))}: {report.content}")
    for line in report.found:
        output.print(f"  {line}")


def export_recording(output: Output, source: Path, out: Path, name: LogFormat, camera: str, max_frames: int) -> None:
    """Write a log in the format of another program, and say what was left out."""
    prepare_folder(out.parent)
    with open_log(source) as log, frame_progress("export", min(len(log), max_frames or len(log))) as bar:
        report = export_log(log, out, name, camera=camera, max_frames=max_frames, on_frame=bar.advance)
        damage, notices = [str(e) for e in log.errors], list(log.notices)
    output.print(f"{out}: {counted(report.frames, 'frame')} ({name})")
    for notice in (*notices, *report.notices):
        output.print(f"  note: {notice}")
    output.lines([f"  left out: {line}" for line in (*damage, *report.left_out)])


@verb
def merge(
    output: JsonOutput,
    maps: list[str],  # saved maps, folders with one, stores of `fleet run map`, or URLs of these
    *,
    out: Path,  # map to write (.npz)
    # JSON: an object of [x, y, z, yaw_deg] or 4 rows of 4 by names of maps; poses of others are found by what they show
    poses: Path | None = None,
) -> None:
    """Merge maps of one place into one map.

    What all have measured adds up. Where a map lies is found by the features that maps keep, and refused where it is
    uncertain. The world is that of the first map, or of --poses. Shifts by whole voxels are exact; for others, voxels
    are interpolated. A map is named by its log, its file or its folder. Settings are those of the first map; what does
    not fit in memory goes to disk.

    Example: semantic-mapper merge runs/east runs/west runs/attic --out house.npz
    Example: semantic-mapper merge runs/fleet --poses poses.json --out house.npz
    """
    given = {} if poses is None else read_poses(poses)
    sources = find_maps(maps)
    refuse_overwriting(out, *(Path(source) for source in sources.values() if not is_url(source)))
    prepare_file(out)
    with frame_progress("merge", len(sources), unit="maps") as bar:
        report = merge_maps(sources, given, bar.advance)
        report.merged.save(out)
    frames, blocks = report.merged.frames, report.merged.block_count
    found = {name: T.tolist() for name, T in report.poses.items()}
    output.json({"map": str(out), "poses": found, "frames": frames, "blocks": blocks})
    for note in report.notes:
        output.print(note)
    output.print(f"{out}: {counted(len(sources), 'map')}, {counted(frames, 'frame')}, {counted(blocks, 'block')}")
