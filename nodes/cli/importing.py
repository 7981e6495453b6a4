"""``semantic-mapper import``: recordings of other programs, films, and damaged logs become logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.config import load_config
from semantic_mapper.nodes.cli.film import FilmFlags, RotateOption, import_film_log, is_film, print_film
from semantic_mapper.nodes.cli.options import MaxFramesOption
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers import ImportOptions, ImportReport, RenameConfig, import_recording
from semantic_mapper.replay.importers.ros_bags import is_bag
from semantic_mapper.replay.log.format import recover
from semantic_mapper.replay.run_folder import LOG_SUFFIX

LISTED = 10  # skipped files and losses that are shown one by one


@verb
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SRC",
            help="Folder of the recording, or ROS bag; film, or folder of pictures without poses; damaged log (.mcap).",
        ),
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log to write (.mcap).")],
    film: FilmFlags,
    format: Annotated[  # noqa: A002 - the name of the option
        Literal[
            "folder",
            "tum",
            "scannet",
            "replica",
            "kitti360",
            "rosbag",
            "polycam",
            "record3d",
            "transforms",
            "colmap",
            "opensfm",
        ]
        | None,
        typer.Option(help="Found out when not given."),
    ] = None,
    max_frames: MaxFramesOption = 0,
    every: Annotated[int, typer.Option(metavar="N", min=1, help="Only every N-th frame.")] = 1,
    rename: Annotated[
        Path | None, typer.Option(help='TOML: [classes] couch = "sofa", ...; classes that get one name become one.')
    ] = None,
    rotate: RotateOption = "0",
    topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=NAME",
            help="ROS bags: topic of the image, depth, info (calibration), depth_info or pose; several times. Found by "
            "type. depth=none: without depth, of every format.",
        ),
    ] = None,
    world: Annotated[
        str, typer.Option(hidden=True, help="ROS bags: frame of tf that poses are in; map, world or odom.")
    ] = "",
    body: Annotated[str, typer.Option(hidden=True, help="ROS bags: frame whose pose the topic of poses tells.")] = "",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log that is there.")] = False,
) -> None:
    """Make a log of a recording of another program, of a film, or of a damaged log.

    Recordings: sequence folder, TUM RGB-D, exported ScanNet, Replica (Semantic-NeRF), KITTI-360, ROS bag (1 or 2),
    Polycam raw data, Record3D (EXR + RGB), transforms.json, COLMAP model with images, OpenSfM or OpenDroneMap project.
    Frames that cannot be used are left out, each with its file and the reason. --rotate is for cameras that are mounted
    on their side: the weights know upright rooms.

    Of a film or a folder of pictures without poses these are found (structure from motion), and a report is written
    next to the log (LOG with .html). Without GPS positions in the pictures, or one of --scale, --distance, --square-mm,
    --camera-height, the lengths of its map are not metres.

    Of a damaged or unfinished log every intact message is kept.

    Example: semantic-mapper import path/to/redkitchen kitchen.mcap
    Example: semantic-mapper import film.mp4 film.mcap --calibration camera.toml --camera-height 1.5
    Example: semantic-mapper import cut-off.mcap clean.mcap
    """
    output = Output.guarded()
    if format is None and source.suffix == LOG_SUFFIX and not is_bag(source):
        _recover(output, source, log)
        return

    renames = load_config(rename, RenameConfig).classes if rename is not None else None
    log.parent.mkdir(parents=True, exist_ok=True)
    if format is None and is_film(source) and (renames is not None or max_frames or every > 1):
        raise typer.BadParameter("a film has no classes to rename, and all of it is read")
    options = ImportOptions(
        max_frames=max_frames or None,
        every=every,
        topics=_topics_by_role(topic or []),
        world=world,
        body=body,
    )
    import_source(output, source, log, film, int(rotate) // 90, format, options, renames, overwrite=overwrite)


def import_source(
    output: Output,
    source: Path,
    log: Path,
    film: FilmFlags,
    quarters: int,
    format_name: str | None = None,
    options: ImportOptions | None = None,
    renames: dict[str, str] | None = None,
    *,
    overwrite: bool,
) -> int:
    """Import a film or a recording, with progress, and say what became of it; how many frames have measured depth.

    Raises:
        typer.BadParameter: options that do not go with the source.
        SemanticMapperError: it cannot be imported.
    """
    from dataclasses import replace

    if format_name is None and is_film(source):
        found, page = import_film_log(source, log, film.film_options(quarters), overwrite=overwrite)
        print_film(output, found, log)
        output.print(f"  {page}  (report on the film)")
        return 0
    with frame_progress("import", None) as bar:

        def on_progress(done: int, total: int) -> None:
            if done == 1:
                bar.start(total)
            bar.set(done)

        options = replace(options or ImportOptions(), quarters=quarters, scale=film.recording_scale())
        report = import_recording(
            source, log, format_name, on_progress, options=options, renames=renames, overwrite=overwrite
        )
    _print_import(output, report, log)
    return report.with_depth


def _topics_by_role(texts: list[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in texts]
    for role, equals, name in pairs:
        if not equals or not name:
            raise typer.BadParameter(f"--topic {role}: write ROLE=NAME, such as image=/camera/color/image_raw")
    return {role: name for role, _, name in pairs}


def _print_import(output: Output, report: ImportReport, log: Path) -> None:
    """Frames, depth, what had to be assumed, and what was left out and why."""
    labels = "no labels" if not report.labelled else f"{report.labelled} of them labelled"
    output.print(
        f"{log}: {counted(report.frames, 'frame')} ({labels}), {report.bytes / 1e6:.1f} MB, from a '{report.format}'"
    )
    output.print(f"  depth: {_depth_line(report)}")
    for notice in report.notices:
        output.print(f"  note: {notice}")
    for skipped in report.skipped[:LISTED]:
        what = "label left out" if skipped.label_only else "frame left out"
        output.print(f"  {what}: frame {skipped.frame}: {skipped.file}: {skipped.reason}")
    if len(report.skipped) > LISTED:
        output.print(f"  and {len(report.skipped) - LISTED} more")


def _depth_line(report: ImportReport) -> str:
    if not report.with_depth:
        return "no frame has a depth image"
    missing = report.frames - report.with_depth
    without = f"; {missing} of {counted(report.frames, 'frame')} without a depth image" if missing else ""
    median = f"; half of the first image is nearer than {report.median_depth_m:.2f} m" if report.median_depth_m else ""
    return f"{report.depth_scale}{median}{without}"


def _recover(output: Output, source: Path, log: Path) -> None:

    report = recover(source, log)
    output.print(
        f"{log}: {counted(report.frames, 'frame')}, {counted(report.messages, 'message')}; "
        f"{len(report.lost)} could not be saved"
    )
    if not report.finished:
        output.print("  the old log had not been closed by its writer")
    for error in report.lost[:LISTED]:
        output.print(f"  lost: {error}")
