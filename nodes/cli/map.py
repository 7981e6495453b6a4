"""``semantic-mapper map``: a film or a recording becomes a map, in one step."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.nodes.cli.film import (
    BoardOption,
    CalibrationOption,
    DistanceOption,
    FocalPriorOption,
    HeightOption,
    ScaleOption,
    SquareOption,
)
from semantic_mapper.nodes.cli.replay import (
    AcceptOption,
    ConfigOption,
    OutOption,
    QualityOption,
    VoxelSizeOption,
    WeightsOption,
    map_exit_code,
    show_replay,
)
from semantic_mapper.nodes.cli.verb import must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest


@verb
def map_(
    source: Annotated[
        Path, typer.Argument(metavar="FILM", help="Film, folder of pictures, or a recording that `import` takes.")
    ],
    out: OutOption,
    calibration: CalibrationOption = None,
    focal_prior: FocalPriorOption = 0.0,
    scale: ScaleOption = 0.0,
    distance: DistanceOption = "",
    square_mm: SquareOption = 0.0,
    board: BoardOption = None,
    camera_height: HeightOption = 0.0,
    rotate: Annotated[
        Literal["0", "90", "180", "270"], typer.Option(help="Turn every image clockwise by this many degrees.")
    ] = "0",
    weights: WeightsOption = None,
    voxel_size: VoxelSizeOption = None,
    config: ConfigOption = None,
    quality: QualityOption = None,
    accept_contradictions: AcceptOption = False,
) -> int:
    """Make a map of a film: finds where the camera was (`import`), then maps the frames (`replay`).

    The folder gets the log (NAME.mcap), the report on the film (NAME.html), and what `replay` writes. Walk slowly,
    sideways, in good light; a camera that turns on the spot shows no depth. A film tells no metres: give one of
    --scale, --distance, --square-mm, --camera-height. Where no frame has depth, the weights are those that have
    learned from computed depth (rooms-computed-depth). The last line is the path of the report.
    Where poses and depth contradict each other, the exit code is 3.

    Example: semantic-mapper map film.mp4 --out runs/film
    Example: semantic-mapper map film.mp4 --out runs/film --calibration camera.toml --camera-height 1.5
    """
    must_be_there(source)
    output = Output.guarded()
    from semantic_mapper.config import load_mapper_config
    from semantic_mapper.fields.checkpoint import COMPUTED_DEPTH, load_checkpoint
    from semantic_mapper.nodes.cli.film import film_options, import_film_log, is_film, print_film, recording_scale
    from semantic_mapper.nodes.cli.imported import print_import
    from semantic_mapper.replay.importers import ImportOptions, import_recording
    from semantic_mapper.replay.jobs import OFFLINE, ReplayRequest, replay_log
    from semantic_mapper.replay.run_folder import hold_folder

    settings = load_mapper_config(config, {"voxel_map.voxel_size_m": voxel_size, "quality": quality}, OFFLINE)
    options = film_options(
        calibration, focal_prior, scale, distance, square_mm, board, camera_height, int(rotate) // 90
    )
    if weights is not None:
        load_checkpoint(weights)  # what is wrong with them is said before the long work
    log = out / f"{source.resolve().stem}.mcap"
    with hold_folder(out):
        if is_film(source):
            report, page = import_film_log(source, log, options, overwrite=True)
            print_film(output, report, log)
            output.print(f"  {page}  (report on the film)")
            with_depth = 0
        else:
            plain = ImportOptions(quarters=int(rotate) // 90, scale=recording_scale(options))
            with frame_progress("import", None) as bar:
                found = import_recording(
                    source, log, on_progress=lambda done, _: bar.set(done), options=plain, overwrite=True
                )
            print_import(output, found, log)
            with_depth = found.with_depth
    with StopRequest() as stop:
        with frame_progress("replay", None, stop=stop) as bar:
            chosen = weights or (None if with_depth else COMPUTED_DEPTH)
            summary = replay_log(ReplayRequest(log, out, chosen, settings), bar).summary
        show_replay(output, summary, out)
        output.print(str(out / "report.html"))
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the map so far is in {out}", style="yellow")
        return map_exit_code(summary, stop, accept_contradictions)
