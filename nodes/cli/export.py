"""The verbs ``export`` (of maps and logs) and ``merge``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.config import Fraction, NotNegative
from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.fusion import SURFACE_WEIGHT
from semantic_mapper.mapping.map_alignment import check_mergeable, find_alignment
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.verb import UpOption, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.exporters import export_log, log_format_of
from semantic_mapper.replay.exporters.map_files import (
    ExportRequest,
    Format,
    export_map,
    format_of,
    parse_transform,
    parse_up,
)
from semantic_mapper.replay.exporters.run import LogFormat
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import is_log, map_path, prepare_file, prepare_folder, refuse_overwriting

Pair = tuple[float, float]


@verb
def export(
    output: Output,
    # Saved map, log, or a folder: of results, or of parts of a log
    source: Annotated[Path, typer.Argument(metavar="MAP|LOG")],
    *,
    out: Path,  # file to write; its ending says the format
    # where the ending does not say it: ply and npz are points, ply-mesh, obj and glb meshes
    format_: Literal[Format, LogFormat] | None = None,
    color: Literal["rgb", "class", "confidence"] | None = None,  # of points and meshes; rgb without it
    min_weight: float = SURFACE_WEIGHT,  # leave out voxels that fewer measurements have seen; 1: and computed depth
    min_confidence: Fraction = 0.0,  # leave surface with a less sure label out
    up: UpOption = "auto",
    # grid: what is in a robot's way, above the floor; without it 0.1 to 1.8 m
    height: Annotated[Pair | None, typer.Option(metavar="LOW HIGH")] = None,
    resolution: float | None = None,  # grid: side of a cell in metres; without it 0.05
    floor: float | None = None,  # grid: height of the floor; found when not given
    costs: Path | None = None,  # grid: also write costs by class, from lines of a TOML file such as `person = 100`
    camera: str = "",  # logs: the frames of this camera only
    max_frames: NotNegative = 0,  # logs: stop after this many; 0 = all
) -> None:
    """Write a saved map, or a log, in a format of other programs.

    Maps: .ply points (with --format ply-mesh a mesh), .obj mesh, .glb mesh for viewers, .npz arrays for
    numpy, .yaml/.pgm floor plan for nav2 and map_server, .rrd for Rerun. In a floor plan a cell is free only where the
    floor was seen. With --costs the costs 0 to 100 of its cells are written next to it (mode raw, unknown 255).

    Logs: .mcap with Foxglove's schemas, .rrd for Rerun, .txt trajectory (TUM), a folder that `import` reads again
    without loss, or with --format tum a TUM RGB-D sequence.

    Example: semantic-mapper export runs/kitchen --out kitchen.glb --color class
    Example: semantic-mapper export runs/kitchen/map.npz --out plan.yaml --height 0.1 1.2
    Example: semantic-mapper export runs/kitchen/map.npz --out plan.yaml --costs costs.toml
    Example: semantic-mapper export kitchen.mcap --out kitchen-foxglove.mcap
    """
    map_options = (color, height, resolution, floor, costs, up, min_weight, min_confidence)
    if is_log(source):
        if map_options != (None, None, None, None, None, "auto", SURFACE_WEIGHT, 0.0):
            raise ConfigError(f"{source}: is a log; only --format, --camera and --max-frames are for logs")
        export_recording(output, source, out, log_format_of(out, format_), camera, max_frames)
        return
    if camera or max_frames:
        raise ConfigError("--camera and --max-frames are for logs; a map has no frames")
    of_grid = (height, resolution, floor, costs)
    request = ExportRequest(format_of(out, format_), min_weight, min_confidence, color, parse_up(up), *of_grid)
    path = map_path(source)
    refuse_overwriting(out, path)
    prepare_file(out)
    report = export_map(VoxelMap.load(path), out, request)
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
    output: Output,
    a: Path,  # saved map, or a folder of results with one
    b: Path,  # another one of the same voxel size and classes
    *,
    out: Path,  # map to write (.npz), in the frame of A
    # where B lies in A: "x y z yaw_deg" (metres; about +z), or a file with T_A_B, 4 rows of 4; "find" = look for it by
    # what both maps show
    transform: str = "find",
) -> None:
    """Make one map of two: what both have measured adds up.

    Where B lies in A is found by the features that both maps keep, and refused where it is uncertain. Shifts
    by whole voxels are exact; for others, B's voxels are interpolated. Settings are those of A.

    Example: semantic-mapper merge runs/east runs/west --out house.npz
    Example: semantic-mapper merge runs/east runs/west --transform "3.2 0 0 90" --out house.npz
    """
    T_a_b = None if transform == "find" else parse_transform(transform)
    sources = map_path(a), map_path(b)
    refuse_overwriting(out, *sources)
    prepare_file(out)
    check_mergeable(*sources, find=T_a_b is None)
    one, other = map(VoxelMap.load, sources)
    if T_a_b is None:
        found = find_alignment(one, other)
        output.print(f"{found.agreeing} of {found.looked_for} places of B are at one on where it lies in A, T_A_B:")
        for row in found.T_map_other:
            output.print("  " + " ".join(f"{value:9.4f}" for value in row))
        T_a_b = found.T_map_other
    joined = one.merged(other, T_a_b)
    joined.save(out)
    blocks = f"{one.block_count} and {other.block_count} made {joined.block_count} blocks"
    output.print(f"{out}: {counted(joined.frames, 'frame')}; {blocks}")
