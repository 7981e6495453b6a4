"""``semantic-mapper import``: recordings of other programs, films, and damaged logs become logs."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from semantic_mapper.config import AtLeastOne, AtLeastZero, HeightM, load_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.map_types import length_unit
from semantic_mapper.nodes.cli.calibrate import board_settings
from semantic_mapper.nodes.cli.verb import MaxFramesOption, Options, OverwriteOption, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import MEGAPIXELS, ImportOptions, ImportReport, RenameConfig
from semantic_mapper.replay.importers.ros_bags import is_bag
from semantic_mapper.replay.importers.run import Format, import_recording, is_recording
from semantic_mapper.replay.log.format import recover
from semantic_mapper.replay.run_folder import LOG_SUFFIX
from semantic_mapper.replay.sfm.film import FILM_SUFFIXES, pictures_of
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, import_film
from semantic_mapper.replay.sfm.scale import ScaleHint


class SourceOptions(Options, frozen=True):
    """Options of what is imported by `import` and by `map`."""

    rotate: Literal["0", "90", "180", "270"] = "0"  # turn images clockwise, degrees
    calibration: Path | None = None  # film: the camera's file, of `calibrate`
    focal_prior: AtLeastZero = 0.0  # film: focal length, some pixels
    scale: AtLeastZero = 0.0  # metres per unit of poses without a scale
    square_mm: AtLeastZero = 0.0  # film: side of a board's square in it
    camera_height: HeightM = 0.0  # film: over the floor, metres
    # bags: ROLE=NAME (image, depth, info, depth_info, pose); repeated. depth=none (any format): without depth
    topic: list[str] | None = None
    world: str = ""  # bags: frame of tf that poses are in
    body: str = ""  # bags: frame that poses are of

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
        if self.topic or self.world or self.body:
            raise ConfigError("a film has no topics and no frames; --topic, --world and --body are for recordings")
        if sum(map(bool, (self.scale, self.square_mm, self.camera_height))) > 1:
            raise ConfigError("the scale comes from one source only: leave out all but one of the options that say it")
        hint = ScaleHint(
            factor=self.scale or None,
            board=board_settings(None, self.square_mm).board if self.square_mm else None,
            camera_height_m=self.camera_height or None,
        )
        return FilmOptions(self.calibration, self.focal_prior or None, hint, self.quarters)

    def reading(self, options: ImportOptions) -> ImportOptions:
        """``options`` with what these say of a recording. Raises typer.BadParameter: some are for films alone."""
        if msgspec.structs.replace(self, scale=0.0, rotate="0", topic=None, world="", body="").given:
            raise typer.BadParameter(
                "the recording has poses and intrinsics of its own; --calibration, --focal-prior, "
                "--square-mm and --camera-height are for films"
            )
        topics, scale = _topics_by_role(self.topic or []), self.scale or None
        return replace(options, quarters=self.quarters, scale=scale, topics=topics, world=self.world, body=self.body)


@verb
def import_(
    output: Output,
    # recording, ROS bag, film, pictures, or damaged log
    source: Annotated[Path, typer.Argument(metavar="SRC")],
    log: Path,  # log to write (.mcap)
    options: SourceOptions,
    *,
    # folder, tum, icl, scannet, replica, nice-slam, 7-scenes, kitti360, rosbag, polycam, record3d, transforms,
    # colmap, opensfm [found out]
    format_: Annotated[Format | None, typer.Option("--format", metavar="FORMAT")] = None,
    max_frames: MaxFramesOption = 0,
    every: AtLeastOne = 1,  # only every N-th frame
    megapixels: AtLeastZero = MEGAPIXELS,  # larger pictures of a recording are made smaller; 0 = never
    rename: Path | None = None,  # TOML: [classes] couch = "sofa", ...
    overwrite: OverwriteOption = False,
) -> None:
    """Make a log of a film or of a recording of another program.

    Frames that cannot be used are left out, with the reason. Poses of a film or a folder of pictures are found; its
    lengths are metres by GPS of the pictures or by one of --scale, --square-mm, --camera-height, or later by `scale`.
    Of a damaged log every intact message is kept. See docs/layouts.md.

    Example: semantic-mapper import path/to/redkitchen kitchen.mcap
    Example: semantic-mapper import film.mp4 film.mcap --camera-height 1.5
    Example: semantic-mapper import cut-off.mcap clean.mcap
    """
    renames = load_config(rename, RenameConfig).classes if rename is not None else {}
    reading = ImportOptions(every, max_frames or None, megapixels=megapixels, renames=renames)
    if format_ is None and source.suffix == LOG_SUFFIX and not is_bag(source):
        if options.given or reading != ImportOptions():
            raise typer.BadParameter("a log is copied as it is; leave out all options", param_hint="SRC")
        _recover(output, source, log)
        return
    log.parent.mkdir(parents=True, exist_ok=True)
    if format_ is None and is_film(source) and reading != ImportOptions():
        raise typer.BadParameter("a film has no classes to rename, and all of it is read, in a size of its own")
    import_source(output, source, log, options, format_, reading, overwrite=overwrite)


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
    format_name: Format | None = None,
    reading: ImportOptions | None = None,
    *,
    overwrite: bool,
) -> None:
    """Import a film or a recording, with progress, and say what became of it.
    Raises typer.BadParameter: options that do not go with the source. SemanticMapperError: it cannot be imported."""
    if format_name is None and is_film(source):
        _import_film(output, source, log, options.film_options(), overwrite=overwrite)
        return
    reading = options.reading(reading or ImportOptions())
    with frame_progress("import", None) as bar:
        show = partial(bar.report, "")
        report = import_recording(source, log, format_name, show, options=reading, overwrite=overwrite)
    _print_import(output, report, log)


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
    output.lines([f"  not saved: {error}" for error in report.lost])


def _import_film(output: Output, source: Path, log: Path, options: FilmOptions, *, overwrite: bool) -> None:
    """Import a film with progress, and say what became of it."""
    with frame_progress("import", None) as bar:
        report = import_film(source, log, options, bar.report, overwrite=overwrite)
    pictures = source.is_dir() and pictures_of(source)[0].parent  # perhaps of a folder in it
    unit, note, megabytes = length_unit(bool(report.scale)), report.note, log.stat().st_size / 1e6
    frames = f"{len(report.T_world_camera)} of {counted(note.frames, 'frame')}"
    output.print(f"{log}: {frames}, {megabytes:.1f} MB, from {pictures or source}")
    figures = {
        "scale": report.scale or "unknown: lengths are not metres",
        "registered": f"{note.registered} of {note.picked} frames that structure from motion was given",
        "left out": ", ".join(f"{count} {reason}" for reason, count in note.left_out.items()) or "none",
        "reprojection error": f"{note.error_px:.2f} px, mean over {report.points} points",
        "focal length": f"{note.focal_px:.1f} px of the film, {report.focal_source}",
        "distortion": ", ".join(f"{value:.4f}" for value in report.distortion) or "none",
        "path length": f"{report.path_m:.2f} {unit}",
    }
    if report.height_m is not None:
        figures["camera over the floor"] = f"{report.height_m:.2f} {unit}"
    for name, value in figures.items():
        output.print(f"  {name}: {value}")
    for notice in report.notices:
        output.print(f"  note: {notice}")
    output.lines([f"  left out: {stretch}" for stretch in report.left_out])
