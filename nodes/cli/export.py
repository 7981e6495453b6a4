"""The verbs ``export`` (of maps and logs) and ``merge``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.fusion import SURFACE_WEIGHT
from semantic_mapper.mapping.map_alignment import check_mergeable, find_alignment
from semantic_mapper.mapping.merge import count_empty
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.exporters import export_log, log_format_of
from semantic_mapper.replay.exporters.map_files import ExportRequest, export_map, format_of, parse_transform, parse_up
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import (
    is_log,
    map_path,
    prepare_file,
    prepare_folder,
    refuse_overwriting,
)

LISTED = 10  # frames left out that are shown one by one


@verb
def export(
    source: Annotated[
        Path,
        typer.Argument(metavar="MAP|LOG", help="Saved map, log, or a folder: of results, or of parts of a log."),
    ],
    out: Annotated[Path, typer.Option("--out", help="File to write; its ending says the format.")],
    format: Annotated[  # noqa: A002 - the name of the option
        Literal["ply", "ply-mesh", "obj", "glb", "npz", "grid", "rrd", "foxglove", "trajectory", "tum", "folder"]
        | None,
        typer.Option(help="Where the ending does not say it: ply and npz are points, ply-mesh, obj and glb meshes."),
    ] = None,
    color: Annotated[
        Literal["rgb", "class", "confidence"] | None, typer.Option(help="Of points and meshes.  [default: rgb]")
    ] = None,
    min_weight: Annotated[
        float | None,
        typer.Option(help="Leave out voxels that fewer measurements have seen; 1 leaves out computed depth."),
    ] = None,
    min_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Leave surface with a less sure label out.")
    ] = 0.0,
    up: Annotated[
        str, typer.Option(help="glb, grid: up in the world: x, -y, ..., or three numbers; auto = away from the floor.")
    ] = "auto",
    height: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="grid: what is in a robot's way, above the floor.  [default: 0.1 1.8]"),
    ] = None,
    resolution: Annotated[float | None, typer.Option(help="grid: side of a cell in metres.  [default: 0.05]")] = None,
    floor: Annotated[float | None, typer.Option(help="grid: height of the floor; found when not given.")] = None,
    costs: Annotated[
        Path | None,
        typer.Option(metavar="TOML", help="grid: also write costs by class, from lines such as `person = 100`."),
    ] = None,
    camera: Annotated[str, typer.Option(help="Logs: the frames of this camera only.")] = "",
    max_frames: Annotated[int, typer.Option(min=0, help="Logs: stop after this many; 0 = all.")] = 0,
) -> None:
    """Write a saved map, or a log, in a format of other programs.

    Maps: .ply points (with --format ply-mesh a mesh), .obj mesh with materials, .glb mesh for viewers, .npz arrays for
    numpy, .yaml/.pgm floor plan for nav2 and map_server, .rrd for Rerun. In a floor plan a cell is free only where the
    floor was seen. With --costs the costs 0 to 100 of its cells are written next to it (mode raw, unknown 255).

    Logs: .mcap with Foxglove's schemas, .rrd for Rerun, .txt trajectory (TUM), a folder that `import` reads again
    without loss, or with --format tum a TUM RGB-D sequence.

    Example: semantic-mapper export runs/kitchen --out kitchen.glb --color class
    Example: semantic-mapper export runs/kitchen/map.npz --out plan.yaml --height 0.1 1.2
    Example: semantic-mapper export runs/kitchen/map.npz --out plan.yaml --costs costs.toml
    Example: semantic-mapper export kitchen.mcap --out kitchen-foxglove.mcap
    """
    output = Output.guarded()
    if is_log(source):
        given = {"--color": color, "--height": height, "--resolution": resolution, "--floor": floor}
        given |= {"--costs": costs}
        given |= {"--up": up != "auto", "--min-weight": min_weight is not None, "--min-confidence": min_confidence > 0}
        map_options = [name for name, value in given.items() if value]
        return export_recording(output, source, out, format, camera, max_frames, map_options)

    if camera or max_frames:
        raise ConfigError("--camera and --max-frames are for logs; a map has no frames")
    kind = format_of(out, format)
    least = SURFACE_WEIGHT if min_weight is None else min_weight
    request = ExportRequest(kind, least, min_confidence, color, parse_up(up), height, resolution, floor, costs)
    return _export_map(output, source, out, request)


def _export_map(output: Output, folder_or_map: Path, out: Path, request: ExportRequest) -> None:

    source = map_path(folder_or_map)
    refuse_overwriting(out, source)
    prepare_file(out)
    report = export_map(VoxelMap.load(source), out, request)
    output.print(f"{' and '.join(map(str, report.files))}: {report.content}")
    for line in report.found:
        output.print(f"  {line}")


@verb
def merge(
    a: Annotated[Path, typer.Argument(metavar="A", help="Saved map, or a folder of results with one.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another one of the same voxel size and classes.")],
    out: Annotated[Path, typer.Option("--out", help="Map to write (.npz), in the frame of A.")],
    transform: Annotated[
        str,
        typer.Option(
            help='Where B lies in A: "x y z yaw_deg" (metres; about +z), or a file with T_A_B, 4 rows of 4; "find" = '
            "look for it by what both maps show."
        ),
    ] = "find",
) -> None:
    """Make one map of two: what both have measured adds up.

    Where B lies in A is found by the features that both maps keep, and refused where it is uncertain. Shifts
    by whole voxels are exact; for others, B's voxels are interpolated. Settings are those of A.

    Example: semantic-mapper merge runs/east runs/west --out house.npz
    Example: semantic-mapper merge runs/east runs/west --transform "3.2 0 0 90" --out house.npz
    """
    output = Output.guarded()

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
    empty = 0
    for source in (one, other):
        with source.locked() as grid:
            empty += count_empty(grid)
    blocks = f"{one.block_count} and {other.block_count} made {joined.block_count} blocks"
    if empty:
        blocks += f"; {empty} empty blocks of the two, in which nothing was measured, are left out"
    output.print(f"{out}: {counted(joined.frames, 'frame')}; {blocks}")


def export_recording(
    output: Output,
    source: Path,
    out: Path,
    format_name: str | None,
    camera: str,
    max_frames: int,
    map_options: Sequence[str],
) -> None:
    """Write a log in the format of another program, and say what was left out.

    Args:
        output: For people.
        source: Log, or a folder with the parts of one.
        out: File or folder to make.
        format_name: None = by the ending.
        camera: Empty = all.
        max_frames: 0 = all.
        map_options: Options given that mean something for maps only.

    Raises:
        ConfigError: options that do not go together.
        LogError: the log cannot be read, or the result not be written.
    """
    if map_options:
        raise ConfigError(f"{', '.join(map_options)}: for saved maps only; {source} is a log")
    name = log_format_of(out, format_name)
    prepare_folder(out.parent)
    with open_log(source) as log, frame_progress("export", min(len(log), max_frames or len(log))) as bar:
        report = export_log(log, out, name, camera=camera, max_frames=max_frames, on_frame=bar.advance)
        damage, notices = [str(e) for e in log.errors], list(log.notices)
    output.print(f"{out}: {counted(report.frames, 'frame')} ({name})")
    for notice in (*notices, *report.notices):
        output.print(f"  note: {notice}")
    lost = [*damage, *report.left_out]
    for line in lost[:LISTED]:
        output.print(f"  left out: {line}")
    if len(lost) > LISTED:
        output.print(f"  and {len(lost) - LISTED} more")
