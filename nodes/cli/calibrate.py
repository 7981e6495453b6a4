"""``semantic-mapper calibrate``: lenses, and where the cameras of a rig sit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.config import load_config
from semantic_mapper.drivers.calibrating.rig import Calibration, solve
from semantic_mapper.drivers.poses.board import sheet_png
from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.calibration.report import (
    CalibrationSettings,
    report,
    report_json,
    write_files,
    write_stereo,
    write_whole,
)
from semantic_mapper.nodes.calibration.sources import Gathering, check_places, parse_sources, parse_stereo
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.run_folder import folder_for_results, prepare_file

_WORST = 3  # views named in the report


@verb
def calibrate(
    sources: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=]PLACE...",
            help="Camera (v4l2:DEVICE, oak:ID, realsense:ID, opencv:URL), video, log (.mcap), folder of pictures; of a "
            "rig several.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for NAME.toml and NAME.png.")] = Path("calibration"),
    board: Annotated[
        Path | None, typer.Option("--board", help="Write the board, to be printed, to this PNG file.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="TOML file with [board] (as a pose source of kind board) and [calibration]."),
    ] = None,
    square_mm: Annotated[
        float, typer.Option(help="Side of a square as measured on the printed board; markers scale with it.")
    ] = 0.0,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT to ask of V4L2 cameras: that of their later use.")] = "",
    known: Annotated[
        bool, typer.Option("--known", help="Keep the intrinsics that the source tells; find the rig alone.")
    ] = False,
    stereo: Annotated[
        bool, typer.Option("--stereo", help="The source gives two images side by side: one file for the pair.")
    ] = False,
    rig: Annotated[bool, typer.Option("--rig/--no-rig", help="Of several cameras, also find where they sit.")] = True,
    seconds: Annotated[float, typer.Option(help="How long to look through live cameras, at most.")] = 180.0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """Calibrate cameras from images of a printed ChArUco board, and where they sit on a rig that has several.

    Print the board (--board), glue it to something flat, measure a square (--square-mm). Show it to the camera near and
    far, at all edges and corners of the image, leaning up, down and to both sides; hold it still each time. Cameras of
    a rig have to see it at the same time; the first one is where the rig is. Poor coverage is refused, with what is
    missing. Drivers take NAME.toml as `calibration`.

    Example: semantic-mapper calibrate --board board.png
    Example: semantic-mapper calibrate v4l2:/dev/video0 --size 1280x720 --square-mm 39.6 --out calibration
    Example: semantic-mapper calibrate --stereo v4l2:/dev/video0 --size 2560x720 --square-mm 39.6
    Example: semantic-mapper calibrate left=pictures/left right=pictures/right
    """
    output = Output.guarded()

    check_places(sources or ())

    settings = board_settings(config, square_mm)
    if board is not None:
        _draw_board(output, settings, board, json)
        if not sources:
            return
    if not sources:
        raise typer.BadParameter("name a camera, video, log or folder; or --board FILE.png to print a board")
    with folder_for_results(out):
        if stereo:
            name, found, gathered = _calibrate_stereo(sources, settings, size, seconds)
            files = write_stereo(out, name, found, settings)
        else:
            found, gathered = _calibrate(sources, settings, size, known=known, rig=rig, seconds=seconds)
            files = write_files(out, found, settings)
    if json:
        output.json(report_json(found, gathered.cameras, files))
        return
    for part in report(found, gathered.cameras, _WORST):
        output.print(part)
    for path in files:
        output.print(str(path))


def board_settings(path: Path | None, square_mm: float) -> Any:
    """Board and settings of a file (None = defaults), with squares of so many millimetres (0 = as it says).

    Raises:
        ConfigError: the file, or a board that cannot be.
    """
    import msgspec

    settings = load_config(path, CalibrationSettings) if path else CalibrationSettings()
    if square_mm < 0:
        raise ConfigError(f"--square-mm {square_mm:g}: is the side of a square in millimetres")
    if not square_mm:
        return settings
    board = settings.board
    scaled = msgspec.structs.replace(
        board, square_m=square_mm / 1000, marker_m=board.marker_m * square_mm / 1000 / board.square_m
    )
    return msgspec.structs.replace(settings, board=scaled)


def _draw_board(output: Output, settings: Any, path: Path, json: bool) -> None:

    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: the board is written as a PNG picture; give a name that ends with .png")
    prepare_file(path)
    write_whole(path, sheet_png(settings.board))
    if not json:
        b = settings.board
        output.print(
            f"{path}: {b.columns} x {b.rows} squares of {1000 * b.square_m:g} mm; print it at 100 %, on "
            "something flat, and measure a square"
        )


def _calibrate(
    sources: list[str], settings: Any, size: str, *, known: bool, rig: bool, seconds: float
) -> tuple[Calibration, Gathering]:

    places = parse_sources(sources, size)
    gathered = Gathering(settings.board, settings.calibration)
    with StopRequest() as stop:
        gathered.run(places, stop, seconds, rig=rig and len(places) > 1)
    keep = set(gathered.cameras) if known else gathered.known
    rig = rig and len(gathered.cameras) > 1
    if keep == set(gathered.cameras) and not rig and not known:
        names = ", ".join(keep) or "none"
        raise ConfigError(f"{names}: calibrated by its maker already; name several cameras to find where they sit")
    return solve(gathered.cameras, keep, settings.calibration, rig=rig), gathered


def _calibrate_stereo(
    sources: list[str], settings: Any, size: str, seconds: float
) -> tuple[str, Calibration, Gathering]:

    name, source = parse_stereo(sources, size)
    gathered = Gathering(settings.board, settings.calibration)
    with StopRequest() as stop:
        gathered.run([source], stop, seconds, rig=True)
    return name, solve(gathered.cameras, (), settings.calibration, rig=True), gathered
