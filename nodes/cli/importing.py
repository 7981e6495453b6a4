"""``semantic-mapper import``: recordings of other programs, films, and damaged logs become logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import typer

from semantic_mapper.config import AtLeastOne, AtLeastZero, load_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.map_types import length_unit
from semantic_mapper.nodes.cli.calibrate import board_settings
from semantic_mapper.nodes.cli.verb import MaxFramesOption, Options, OverwriteOption, refuse_options, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.plots import new_figure, rendered
from semantic_mapper.replay.importers import (
    FORMATS,
    ImportOptions,
    ImportReport,
    RenameConfig,
    import_recording,
    is_recording,
)
from semantic_mapper.replay.importers.ros_bags import is_bag
from semantic_mapper.replay.log.format import recover
from semantic_mapper.replay.page import Section, picture, table_of, write_page
from semantic_mapper.replay.run_folder import LOG_SUFFIX
from semantic_mapper.replay.sfm.film import FILM_SUFFIXES, pictures_of
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, FilmReport, import_film
from semantic_mapper.replay.sfm.scale import ScaleHint, parse_distance

STRETCHES = 30  # of the film that are left out, in its report
_STAGES = {
    "look": "look through the film",
    "features": "find features",
    "match": "match frames",
    "map": "find poses",
    "write": "write the log",
}


class SourceOptions(Options, frozen=True):
    """Options of films, and of recordings whose unit of length is not known."""

    rotate: Literal["0", "90", "180", "270"] = "0"  # turn images clockwise, degrees
    calibration: Path | None = None  # film: the camera's file, of `calibrate`
    focal_prior: AtLeastZero = 0.0  # film: focal length, some pixels
    scale: AtLeastZero = 0.0  # metres per unit of poses without a scale
    distance: str = ""  # film: "SECONDS:U,V SECONDS:U,V METRES"
    square_mm: AtLeastZero = 0.0  # film: side of a board's square in it
    camera_height: AtLeastZero = 0.0  # film: over the floor, metres

    @property
    def quarters(self) -> int:
        """Of a full turn, clockwise."""
        return int(self.rotate) // 90

    @property
    def given(self) -> bool:
        """Whether any of them is."""
        return self != type(self)()

    def film_options(self) -> FilmOptions:
        """As the import of films takes them. Raises ConfigError: values that cannot be, or that exclude each other."""
        if sum(map(bool, (self.scale, self.distance, self.square_mm, self.camera_height))) > 1:
            raise ConfigError("the scale comes from one source only: leave out all but one of the options that say it")
        hint = ScaleHint(
            factor=self.scale or None,
            distance=parse_distance(self.distance) if self.distance else None,
            board=board_settings(None, self.square_mm).board if self.square_mm else None,
            camera_height_m=self.camera_height or None,
        )
        return FilmOptions(self.calibration, self.focal_prior or None, hint, self.quarters)

    def recording_scale(self) -> float | None:
        """Metres per unit, of a recording that has poses.

        Raises:
            typer.BadParameter: options were given that are for films alone.
        """
        if msgspec.structs.replace(self, scale=0.0, rotate="0").given:
            raise typer.BadParameter(
                "the recording has poses and intrinsics of its own; --calibration, --focal-prior, --distance, "
                "--square-mm and --camera-height are for films"
            )
        return self.scale or None


@verb
def import_(
    output: Output,
    # Recording, ROS bag, film, folder of pictures, or damaged log
    source: Annotated[Path, typer.Argument(metavar="SRC")],
    log: Path,  # log to write (.mcap)
    options: SourceOptions,
    *,
    # folder, tum, scannet, replica, kitti360, rosbag, polycam, record3d, transforms, colmap or opensfm [found out]
    format_: str | None = None,
    max_frames: MaxFramesOption = 0,
    every: AtLeastOne = 1,  # only every N-th frame
    rename: Path | None = None,  # TOML: [classes] couch = "sofa", ...
    # bags: of image, depth, info, depth_info or pose; repeated. depth=none (any format): without depth
    topic: Annotated[list[str] | None, typer.Option(metavar="ROLE=NAME")] = None,
    world: str = "",  # bags: frame of tf that poses are in
    body: str = "",  # bags: frame that poses are of
    overwrite: OverwriteOption = False,
) -> None:
    """Make a log of a recording of another program, of a film, or of a damaged log.

    Frames that cannot be used are left out, with the reason. --rotate is for cameras mounted on their side. Poses of a
    film or a folder of pictures are found, with a report (LOG with .html); its lengths are metres by GPS of the
    pictures or by one of --scale, --distance, --square-mm, --camera-height. Of a damaged log every intact message is
    kept. See docs/recordings.md.

    Example: semantic-mapper import path/to/redkitchen kitchen.mcap
    Example: semantic-mapper import film.mp4 film.mcap --calibration camera.toml --camera-height 1.5
    Example: semantic-mapper import cut-off.mcap clean.mcap
    """
    refuse_options((format_ not in (None, *FORMATS), "--format", f"there are {', '.join(FORMATS)}"))
    if format_ is None and source.suffix == LOG_SUFFIX and not is_bag(source):
        _recover(output, source, log)
        return
    renames = load_config(rename, RenameConfig).classes if rename is not None else None
    log.parent.mkdir(parents=True, exist_ok=True)
    if format_ is None and is_film(source) and (renames is not None or max_frames or every > 1):
        raise typer.BadParameter("a film has no classes to rename, and all of it is read")
    reading = ImportOptions(
        max_frames=max_frames or None, every=every, topics=_topics_by_role(topic or []), world=world, body=body
    )
    import_source(output, source, log, options, format_, reading, renames, overwrite=overwrite)


def is_film(source: Path) -> bool:
    """Whether poses have to be found: of a film, or of a folder of pictures that is no recording of a known format."""
    if source.is_file():
        return source.suffix.lower() in FILM_SUFFIXES
    return source.is_dir() and not is_recording(source) and bool(pictures_of(source))


def import_source(
    output: Output,
    source: Path,
    log: Path,
    options: SourceOptions,
    format_name: str | None = None,
    reading: ImportOptions | None = None,
    renames: dict[str, str] | None = None,
    *,
    overwrite: bool,
) -> int:
    """Import a film or a recording, with progress, and say what became of it; how many frames have measured depth.

    Raises:
        typer.BadParameter: options that do not go with the source.
        SemanticMapperError: it cannot be imported.
    """
    if format_name is None and is_film(source):
        _import_film(output, source, log, options.film_options(), overwrite=overwrite)
        return 0
    reading = replace(reading or ImportOptions(), quarters=options.quarters, scale=options.recording_scale())
    with frame_progress("import", None) as bar:

        def on_progress(done: int, total: int) -> None:
            if done == 1:
                bar.start(total)
            bar.set(done)

        report = import_recording(
            source, log, format_name, on_progress, options=reading, renames=renames, overwrite=overwrite
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
    depth = "no frame has a depth image"
    if report.with_depth:
        nearer = f"; half of the first image is nearer than {report.median_depth_m:.2f} m"
        missing = report.frames - report.with_depth
        depth = f"{report.depth_scale}{nearer if report.median_depth_m else ''}"
        depth += f"; {counted(missing, 'frame')} without a depth image" if missing else ""
    output.print(f"  depth: {depth}")
    for notice in report.notices:
        output.print(f"  note: {notice}")
    output.lines(
        [
            f"  {'label' if skipped.label_only else 'frame'} left out: frame {skipped.frame}: {skipped.file}: "
            f"{skipped.reason}"
            for skipped in report.skipped
        ]
    )


def _recover(output: Output, source: Path, log: Path) -> None:
    report = recover(source, log)
    output.print(
        f"{log}: {counted(report.frames, 'frame')}, {counted(report.messages, 'message')}; "
        f"{len(report.lost)} could not be saved"
    )
    if not report.finished:
        output.print("  the old log had not been closed by its writer")
    output.lines([f"  lost: {error}" for error in report.lost])


def _import_film(output: Output, source: Path, log: Path, options: FilmOptions, *, overwrite: bool) -> None:
    """Import a film with progress, write its report next to the log, and say what became of it."""
    page = log.with_suffix(".html")
    if page.exists() and not overwrite:
        raise ConfigError(f"{page}: exists already; choose another name, or --overwrite it")
    with frame_progress("import", None) as bar:
        stage = ""

        def show(what: str, done: int, total: int) -> None:
            nonlocal stage
            if what != stage:
                bar.start(total)
                stage = what
            bar.set(done, _STAGES.get(what, what))

        report = import_film(source, log, options, show, overwrite=overwrite)
    write_film_report(report, page)
    output.print(
        f"{log}: {counted(report.frames, 'frame')} of {report.looked_at}, {report.bytes / 1e6:.1f} MB, from a film"
    )
    for name, value in _figures(report).items():
        output.print(f"  {name}: {value}")
    for notice in report.notices:
        output.print(f"  note: {notice}")
    output.print(f"  {page}  (report on the film)")


def write_film_report(report: FilmReport, path: Path) -> None:
    """Write the page on a film: path from above, frames, what is left out."""
    spans = [(f"{p.start_s:.2f}", f"{p.end_s:.2f}", str(p.frames), p.reason) for p in report.left_out[:STRETCHES]]
    counts = [(reason, str(count)) for reason, count in report.left_out_counts.items()]
    frames = [picture(rgb, f"{seconds:.2f} s; rectified", photo=True) for seconds, rgb in report.pictures]
    sections = [
        Section(notes=report.notices, tables=[table_of(("", ""), list(_figures(report).items()))]),
        Section("Path from above", pictures=[picture(_draw_plan(report), "The camera's way, and points of the scene")]),
        Section("Frames", pictures=frames),
        Section("Frames that are left out", tables=[table_of(("reason", "frames"), counts)]),
        Section(
            f"Where in the film, the first {STRETCHES} stretches",
            tables=[table_of(("from, s", "to, s", "frames", "reason"), spans)],
        ),
    ]
    write_page(path, f"Film {report.film.name}: how the camera moved", sections)


def _figures(report: FilmReport) -> Mapping[str, str]:
    unit = length_unit(bool(report.scale))
    found = {
        "scale": report.scale or "unknown: lengths are not metres",
        "registered": f"{report.registered} of {report.picked} frames that structure from motion was given",
        "in the log": f"{report.frames} of {report.looked_at} frames of the film",
        "left out": ", ".join(f"{count} {reason}" for reason, count in report.left_out_counts.items()) or "none",
        "reprojection error": f"{report.error_px:.2f} px, mean over {report.points} points",
        "focal length": f"{report.focal_px:.1f} px of the film, {report.focal_source}",
        "distortion": ", ".join(f"{value:.4f}" for value in report.distortion) or "none",
        "way": f"{report.path_m:.2f} {unit}",
    }
    if report.height_m is not None:
        found["camera over the floor"] = f"{report.height_m:.2f} {unit}"
    return found


@rendered
def _draw_plan(report: FilmReport) -> Any:
    """The path and the points from above, as a picture (H, W, 3)."""
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
