"""``semantic-mapper calibrate``: lenses, and where the cameras of a rig sit."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from semantic_mapper.config import load_config
from semantic_mapper.drivers.calibrating.rig import solve
from semantic_mapper.drivers.poses.board import sheet_png
from semantic_mapper.errors import ConfigError
from semantic_mapper.files import write_bytes
from semantic_mapper.nodes.calibration import report
from semantic_mapper.nodes.calibration.report import CalibrationSettings
from semantic_mapper.nodes.calibration.sources import Gathering, parse_sources
from semantic_mapper.nodes.cli.verb import JsonOutput, verb, wrong_usage
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.run_folder import folder_for_results, prepare_file


@verb
def calibrate(
    output: JsonOutput,
    # Camera (v4l2:DEVICE, oak:ID, realsense:ID, opencv:URL), video, log (.mcap), folder of pictures; of a rig several
    sources: Annotated[list[str] | None, typer.Argument(metavar="[NAME=]PLACE...")] = None,
    *,
    out: Path = Path("calibration"),  # folder for NAME.toml
    board: Path | None = None,  # write the board, to be printed, to this PNG file
    config: Path | None = None,  # TOML file with [board] (as a pose source of kind board) and [calibration]
    square_mm: float = 0.0,  # side of a square, as measured on the printed board
    size: str = "",  # WIDTHxHEIGHT of V4L2 cameras, as later in use
    known: bool = False,  # keep the intrinsics that the source tells; find the rig alone
    stereo: bool = False,  # the source gives two images side by side: a folder NAME for the pair
    seconds: float = 180.0,  # how long to look through live cameras, at most
) -> None:
    """Calibrate cameras from images of a printed ChArUco board.

    Print the board (--board), glue it to something flat, measure a square (--square-mm). Show it to the camera near and
    far, at all edges and corners of the image, leaning up, down and to both sides; hold it still each time. Several
    cameras are a rig: they have to see it at the same time, and the first one is where the rig is. Poor coverage is
    refused, with what is missing. Drivers take NAME.toml, of a pair the folder, as `calibration`.

    Example: semantic-mapper calibrate --board board.png
    Example: semantic-mapper calibrate v4l2:/dev/video0 --square-mm 39.6
    Example: semantic-mapper calibrate --stereo v4l2:/dev/video0 --size 2560x720
    Example: semantic-mapper calibrate left=pictures/left right=pictures/right
    """
    with wrong_usage():
        settings = board_settings(config, square_mm)
    if board is not None:
        _draw_board(output, settings, board)
        if not sources:
            return
    if not sources:
        raise typer.BadParameter("name a camera, video, log or folder; or --board FILE.png to print a board")
    with folder_for_results(out):
        gathered = Gathering(settings.board, settings.calibration)
        places = parse_sources(sources, size, stereo=stereo)
        with StopRequest() as stop:
            gathered.run(places, stop, seconds, rig=stereo or len(places) > 1)
        rig = len(gathered.cameras) > 1
        keep = set(gathered.cameras) if known else set() if stereo else gathered.known
        if keep == set(gathered.cameras) and not rig and not known:
            names = ", ".join(keep) or "none"
            raise ConfigError(f"{names}: calibrated by its maker already; name several cameras to find where they sit")
        found = solve(gathered.cameras, keep, settings.calibration, rig=rig)
        files = report.write_files(out / places[0].name if stereo else out, found, settings)
    plain = report.as_json(found, gathered.cameras, files)
    for part in (*report.tables(plain), *files):
        output.print(part)
    output.json(plain)


def board_settings(path: Path | None, square_mm: float) -> CalibrationSettings:
    """Board and settings of a file (None = defaults), with squares of so many millimetres (0 = as it says)."""
    settings = load_config(path, CalibrationSettings) if path else CalibrationSettings()
    if square_mm < 0:
        raise ConfigError(f"--square-mm {square_mm:g}: is the side of a square in millimetres")
    if not square_mm:
        return settings
    marker_m = settings.board.marker_m * square_mm / 1000 / settings.board.square_m
    board = msgspec.structs.replace(settings.board, square_m=square_mm / 1000, marker_m=marker_m)
    return msgspec.structs.replace(settings, board=board)


def _draw_board(output: Output, settings: CalibrationSettings, path: Path) -> None:
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: the board is written as a PNG picture; give a name that ends with .png")
    prepare_file(path)
    write_bytes(path, sheet_png(settings.board), raises=ConfigError)
    b = settings.board
    squares = f"{b.columns} x {b.rows} squares of {1000 * b.square_m:g} mm"
    output.print(f"{path}: {squares}; print it at 100 %, on something flat, and measure a square")
