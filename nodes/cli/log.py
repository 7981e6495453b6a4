"""Verbs about what is on disk: ``import``, ``info``, ``recover``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from semantic_mapper.nodes.cli.film import (
    BoardOption,
    CalibrationOption,
    DistanceOption,
    FocalPriorOption,
    HeightOption,
    ScaleOption,
    SquareOption,
    film_options,
    import_film_log,
    is_film,
    print_film,
    recording_scale,
)
from semantic_mapper.nodes.cli.imported import print_import
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted

LISTED = 10  # damages that are shown one by one


@verb
def import_(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SRC",
            help="Folder of the recording, or ROS bag; or film, or folder of pictures, without poses.",
        ),
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log to write (.mcap).")],
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
    max_frames: Annotated[int, typer.Option(min=0, help="Stop after this many; 0 = all.")] = 0,
    every: Annotated[int, typer.Option(metavar="N", min=1, help="Only every N-th frame.")] = 1,
    rename: Annotated[
        Path | None, typer.Option(help='TOML: [classes] couch = "sofa", ...; classes that get one name become one.')
    ] = None,
    rotate: Annotated[
        Literal["0", "90", "180", "270"], typer.Option(help="Turn every image clockwise by this many degrees.")
    ] = "0",
    topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=NAME",
            help="ROS bags: topic of the image, depth, info (calibration), depth_info or pose; several times. Found by "
            "type. depth=none: without depth, of every format.",
        ),
    ] = None,
    world: Annotated[str, typer.Option(help="ROS bags: frame of tf that poses are in; map, world or odom.")] = "",
    body: Annotated[str, typer.Option(help="ROS bags: frame whose pose the topic of poses tells.")] = "",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log that is there.")] = False,
    calibration: CalibrationOption = None,
    focal_prior: FocalPriorOption = 0.0,
    scale: ScaleOption = 0.0,
    distance: DistanceOption = "",
    square_mm: SquareOption = 0.0,
    board: BoardOption = None,
    camera_height: HeightOption = 0.0,
) -> None:
    """Make a log of a recording: sequence folder, TUM RGB-D, exported ScanNet, Replica (Semantic-NeRF), KITTI-360, ROS
    bag, Polycam raw data, Record3D (EXR + RGB), transforms.json (nerfstudio, instant-ngp), COLMAP model with images,
    OpenSfM or OpenDroneMap project.

    Of a film or a folder of pictures without poses these are found (structure from motion), and a report is written
    beside the log (LOG with .html). Without GPS positions in the pictures, or one of --scale, --distance, --square-mm,
    --camera-height, the lengths of its map are not metres.

    Frames that cannot be used are left out, each with its file and the reason. --rotate is for cameras that are mounted
    on their side: the weights know upright rooms. Poses and intrinsics turn with the images. Of a ROS bag (1 or 2),
    poses come from tf or from odometry, and one camera is imported.

    Example: semantic-mapper import path/to/redkitchen kitchen.mcap
    Example: semantic-mapper import robot.bag robot.mcap --topic image=/front/color/image_raw
    Example: semantic-mapper import film.mp4 film.mcap --calibration camera.toml --camera-height 1.5
    Example: semantic-mapper import path/to/adt flat.mcap --rotate 90 --rename adt-to-rooms.toml
    """
    output = Output.guarded()
    from semantic_mapper.config import load_config
    from semantic_mapper.replay.importers import ImportOptions, RenameConfig, import_recording

    renames = load_config(rename, RenameConfig).classes if rename is not None else None

    log.parent.mkdir(parents=True, exist_ok=True)
    film = film_options(calibration, focal_prior, scale, distance, square_mm, board, camera_height, int(rotate) // 90)
    if format is None and is_film(source):
        if renames is not None or max_frames or every > 1:
            raise typer.BadParameter("a film has no classes to rename, and all of it is read")
        found, page = import_film_log(source, log, film, overwrite=overwrite)
        print_film(output, found, log)
        output.print(f"  {page}  (report)")
        return
    with frame_progress("import", None) as bar:

        def on_progress(done: int, total: int) -> None:
            if done == 1:
                bar.start(total)
            bar.set(done)

        options = ImportOptions(
            max_frames=max_frames or None,
            every=every,
            quarters=int(rotate) // 90,
            topics=_topics_by_role(topic or []),
            world=world,
            body=body,
            scale=recording_scale(film),
        )
        report = import_recording(
            source, log, format, on_progress, options=options, renames=renames, overwrite=overwrite
        )
    print_import(output, report, log)


def _topics_by_role(texts: list[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in texts]
    for role, equals, name in pairs:
        if not equals or not name:
            raise typer.BadParameter(f"--topic {role}: write ROLE=NAME, such as image=/camera/color/image_raw")
    return {role: name for role, _, name in pairs}


@verb
def info(
    file: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Recorded log (.mcap), its parts or their folder; or saved map, or a folder with map.npz.",
        ),
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Say what a log holds (topics, frames, cameras, duration, gaps, damage), or a map (frames, size, blocks, classes).

    Of a log it reads every message, so that damage anywhere is found; exit code 1 where there is any. Of a map it reads
    what the file says of itself, which is quick however large the map is.

    Example: semantic-mapper info kitchen.mcap
    Example: semantic-mapper info runs/demo
    """
    output = Output.guarded()
    from semantic_mapper.replay.run_folder import is_map, map_path

    if is_map(file[0]):
        if len(file) > 1:
            raise typer.BadParameter("one map at a time")
        return _map_info(output, map_path(file[0]), json)
    from semantic_mapper.nodes.cli.log_info import describe_log, info_table

    with frame_progress("read", None, unit="messages") as bar:
        found = describe_log(file, bar.advance)
    if json:
        output.json(found)
    else:
        output.print(info_table(found))
        _print_damage(output, found)
    return EXIT_FAILED if found["damage"] else 0


def _map_info(output: Output, file: Path, json: bool) -> int:
    from semantic_mapper.nodes.cli.map_info import map_summary, map_table

    found = map_summary(file)
    if json:
        output.json(found)
    else:
        output.print(map_table(found))
    return 0


def _print_damage(output: Output, found: dict[str, Any]) -> None:
    for notice in found["notices"]:
        output.print(f"note: {notice}")
    for damage in found["damage"][:LISTED]:
        output.print(f"damaged: {damage}")
    if len(found["damage"]) > LISTED:
        output.print(f"and {len(found['damage']) - LISTED} more")
    if found["damage"] or not found["finished"]:
        log = Path(found["parts"][0])  # parts are mended one by one
        output.print(
            f"`semantic-mapper recover {log} {log.with_stem(log.stem + '-recovered')}` makes a clean log of it"
        )


@verb
def recover(
    source: Annotated[Path, typer.Argument(metavar="SRC", help="Damaged or unfinished log; is not changed.")],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="New log to write.")],
) -> None:
    """Make a clean log of a damaged or unfinished one: every intact message is kept.

    Example: semantic-mapper recover cut-off.mcap clean.mcap
    """
    output = Output.guarded()
    from semantic_mapper.replay.log.format import recover as recover_log

    report = recover_log(source, log)
    output.print(
        f"{log}: {counted(report.frames, 'frame')}, {counted(report.messages, 'message')}; "
        f"{len(report.lost)} could not be saved"
    )
    if not report.finished:
        output.print("  the old log had not been closed by its writer")
    for error in report.lost[:LISTED]:
        output.print(f"  lost: {error}")
