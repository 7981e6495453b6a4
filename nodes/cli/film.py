"""What the verbs that take films share: options, progress, what is said of a film, and its report."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.map_types import length_unit
from semantic_mapper.nodes.cli.calibrate import board_settings
from semantic_mapper.nodes.cli.options import DataOptions
from semantic_mapper.nodes.console import FrameProgress, Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.plots import new_figure, rendered
from semantic_mapper.replay.importers import is_recording
from semantic_mapper.replay.page import Section, picture, table_of, write_page
from semantic_mapper.replay.sfm.film import FILM_SUFFIXES, pictures_of
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, FilmReport, import_film
from semantic_mapper.replay.sfm.scale import ScaleHint, parse_distance

LISTED = 30  # stretches of the film that are left out

RotateOption = Annotated[
    Literal["0", "90", "180", "270"], typer.Option(help="Turn every image clockwise by this many degrees.")
]


@dataclass(frozen=True)
class FilmFlags(DataOptions):
    """Options of films, and of recordings whose unit of length is not known."""

    calibration: Annotated[
        Path | None, typer.Option("--calibration", help="Film: file of the camera, from `calibrate`. Without: found.")
    ] = None
    focal_prior: Annotated[
        float,
        typer.Option("--focal-prior", min=0, hidden=True, help="Film: focal length in its pixels, about. 0 = guessed."),
    ] = 0.0
    scale: Annotated[
        float,
        typer.Option(
            "--scale",
            min=0,
            hidden=True,
            help="Film, transforms, colmap, opensfm: metres per unit of its map without scale. 0 = by GPS, if any.",
        ),
    ] = 0.0
    distance: Annotated[
        str,
        typer.Option(
            "--distance",
            hidden=True,
            help='Film: two marked points: "SECONDS:U,V SECONDS:U,V METRES" (pixels of the film).',
        ),
    ] = ""
    square_mm: Annotated[
        float,
        typer.Option(
            "--square-mm", min=0, hidden=True, help="Film: side of a square of the printed board that is seen in it."
        ),
    ] = 0.0
    board: Annotated[
        Path | None,
        typer.Option(
            "--board", hidden=True, help="Film: TOML file with [board], of another board than `calibrate` prints."
        ),
    ] = None
    camera_height: Annotated[
        float, typer.Option("--camera-height", min=0, help="Film: median height of the camera over the floor, metres.")
    ] = 0.0

    def given(self) -> bool:
        """Whether any of them is."""
        return self != FilmFlags()

    def film_options(self, quarters: int) -> FilmOptions:
        """As the import of films takes them.

        Raises:
            typer.BadParameter: options that exclude each other.
            ConfigError: values that cannot be.
        """
        sources = {
            "--scale": self.scale,
            "--distance": self.distance,
            "--square-mm": self.square_mm,
            "--board": self.board,
            "--camera-height": self.camera_height,
        }
        given = [name for name, value in sources.items() if value]
        if len(given) > 1 and given != ["--square-mm", "--board"]:
            raise typer.BadParameter(
                f"{' and '.join(given)}: the scale comes from one source only; leave out all but one"
            )
        if self.calibration is not None and self.focal_prior:
            raise typer.BadParameter("--calibration and --focal-prior: the focal length is given or guessed, not both")

        board = board_settings(self.board, self.square_mm).board if self.board or self.square_mm else None
        hint = ScaleHint(
            factor=self.scale or None,
            distance=parse_distance(self.distance) if self.distance else None,
            board=board,
            camera_height_m=self.camera_height or None,
        )
        return FilmOptions(self.calibration, self.focal_prior or None, hint, quarters)

    def recording_scale(self) -> float | None:
        """Metres per unit, of a recording that has poses.

        Raises:
            typer.BadParameter: options were given that are for films alone.
        """
        if replace(self, scale=0.0).given():
            raise typer.BadParameter(
                "the recording has poses and intrinsics of its own; --calibration, --focal-prior, --distance, "
                "--square-mm, --board and --camera-height are for films"
            )
        return self.scale or None


def is_film(source: Path) -> bool:
    """Whether poses have to be found: of a film, or of a folder of pictures that is no recording of a known format."""
    if source.is_file():
        return source.suffix.lower() in FILM_SUFFIXES
    return source.is_dir() and not is_recording(source) and bool(pictures_of(source))


def import_film_log(source: Path, log: Path, options: FilmOptions, *, overwrite: bool) -> tuple[FilmReport, Path]:
    """Import a film with progress on stderr, and write its report next to the log.

    Returns:
        What became of it, and the path of its report.

    Raises:
        SemanticMapperError: see ``import_film``.
    """
    page = log.with_suffix(".html")
    if page.exists() and not overwrite:
        raise ConfigError(f"{page}: exists already; choose another name, or --overwrite it")
    with _Stages() as stages:
        report = import_film(source, log, options, stages.show, overwrite=overwrite)
    write_film_report(report, page)
    return report, page


def print_film(output: Output, report: FilmReport, log: Path) -> None:
    """What became of a film, for people."""
    output.print(
        f"{log}: {counted(report.frames, 'frame')} of {report.looked_at}, {report.bytes / 1e6:.1f} MB, from a film"
    )
    for name, value in _figures(report).items():
        output.print(f"  {name}: {value}")
    for notice in report.notices:
        output.print(f"  note: {notice}")


def write_film_report(report: FilmReport, path: Path) -> None:
    """Write the page on a film: path from above, frames, what is left out.

    Raises:
        ConfigError: it cannot be written.
    """
    spans = [(f"{p.start_s:.2f}", f"{p.end_s:.2f}", str(p.frames), p.reason) for p in report.left_out[:LISTED]]
    counts = [(reason, str(count)) for reason, count in report.left_out_counts.items()]
    sections = [
        Section(notes=report.notices, tables=[table_of(("", ""), list(_figures(report).items()))]),
        Section("Path from above", pictures=[picture(_draw_plan(report), "The camera's way, and points of the scene")]),
        Section(
            "Frames",
            pictures=[
                picture(rgb, f"{seconds:.2f} s; pixels of this picture are rectified", photo=True)
                for seconds, rgb in report.pictures
            ],
        ),
        Section("Frames that are left out", tables=[table_of(("reason", "frames"), counts)]),
        Section(
            f"Where in the film, the first {LISTED} stretches",
            tables=[table_of(("from, s", "to, s", "frames", "reason"), spans)],
        ),
    ]
    write_page(path, f"Film {report.film.name}: how the camera moved", sections)


def _figures(report: FilmReport) -> Mapping[str, str]:

    unit = length_unit(bool(report.scale))
    lens = ", ".join(f"{value:.4f}" for value in report.distortion)
    found = {
        "scale": report.scale or "unknown: lengths are not metres",
        "registered": f"{report.registered} of {report.picked} frames that structure from motion was given",
        "in the log": f"{report.frames} of {report.looked_at} frames of the film",
        "left out": ", ".join(f"{count} {reason}" for reason, count in report.left_out_counts.items()) or "none",
        "reprojection error": f"{report.error_px:.2f} px, mean over {report.points} points",
        "focal length": f"{report.focal_px:.1f} px of the film, {report.focal_source}",
        "distortion": lens or "none",
        "way": f"{report.path_m:.2f} {unit}",
    }
    if report.height_m is not None:
        found["camera over the floor"] = f"{report.height_m:.2f} {unit}"
    return found


def _draw_plan(report: FilmReport) -> Any:
    """The path and the points from above, as a picture (H, W, 3)."""
    import numpy as np

    @rendered
    def draw() -> Any:
        unit = "metres" if report.scale else "units"
        figure = new_figure(900, 760, layout="constrained")
        axes = figure.add_subplot(aspect="equal", adjustable="datalim", xlabel=unit, ylabel=unit)
        xyz, way = report.xyz, report.T_world_camera[:, :3, 3]
        if len(xyz):
            low, high = np.percentile(xyz, (2, 98), axis=0)
            near = ((xyz >= low) & (xyz <= high)).all(axis=1)
            axes.plot(xyz[near, 0], xyz[near, 1], ".", markersize=1.5, alpha=0.5, label="points")
        axes.plot(way[:, 0], way[:, 1], "-", label="camera")
        axes.plot(way[:1, 0], way[:1, 1], "o", markersize=9, label="begins here")
        axes.legend(loc="best")
        return figure

    return draw()


class _Stages:
    """One bar after the other."""

    _NAMES: Mapping[str, tuple[str, str]] = {
        "look": ("look through the film", "frames"),
        "features": ("find features", "frames"),
        "match": ("match frames", "pairs"),
        "map": ("find poses", "frames"),
        "write": ("write the log", "frames"),
    }

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._what = ""
        self._bar: FrameProgress | None = None

    def __enter__(self) -> _Stages:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def show(self, what: str, done: int, total: int) -> None:
        """Progress of ``import_film``."""
        if what != self._what or self._bar is None:
            self._stack.close()
            name, unit = self._NAMES.get(what, (what, "steps"))
            self._bar = self._stack.enter_context(frame_progress(name, total, unit=unit))
            self._what = what
        self._bar.set(done)
