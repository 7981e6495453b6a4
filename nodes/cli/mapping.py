"""``semantic-mapper map``: a recording becomes a map, in this process."""

import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import ClassVar

import typer

from semantic_mapper.errors import LogError
from semantic_mapper.nodes.cli.importing import SourceOptions, import_source
from semantic_mapper.nodes.cli.verb import (
    EXIT_EMPTY,
    EXIT_UNTRUSTED,
    JsonOutput,
    MapperSettings,
    MaxFramesOption,
    WeightsOption,
    must_be_there,
    refuse_options,
    verb,
)
from semantic_mapper.nodes.console import frame_progress, stderr_console
from semantic_mapper.nodes.local_server import open_browser
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer.server import ViewerPage
from semantic_mapper.replay.importers.base import ImportOptions
from semantic_mapper.replay.importers.ros_bags import is_bag
from semantic_mapper.replay.importers.run import needs_import
from semantic_mapper.replay.run_folder import LOG_SUFFIX, free_name, hold_folder, is_map
from semantic_mapper.replay.summary import dig, ending


class HiddenSourceOptions(SourceOptions, frozen=True):
    """The same; the help of `import` says what they are."""

    hidden: ClassVar = True


@verb
def map_(
    output: JsonOutput,
    # log (.mcap), its parts, or their folder; or a film, pictures or recording
    source: list[Path],
    mapper: MapperSettings,
    options: HiddenSourceOptions,
    *,
    out: Path | None = None,  # folder for the results [a new runs/NAME]
    weights: WeightsOption = None,
    max_frames: MaxFramesOption = 0,
    rerun: Path | None = None,  # also a Rerun recording (.rrd)
    corrections: Path | None = None,  # corrected poses (TUM)
    accept_untrusted: bool = False,  # exit code 0 in place of 3
    open_: bool = False,  # show the report in a browser at the end
    view: bool = False,  # show frames and map in a browser, until Ctrl-C
) -> int:
    """Map a recording: a log, a film, or what `import` takes.

    Writes report.html, summary.json, map.ply, map.npz and overview.png. What is no log is imported first (options: see
    `import`). Bad frames are refused with the reason. Ctrl-C writes the map so far. Exit code 3: poses
    contradict depth or pictures, or computed depth ends at its range; 4: the map is empty, or nearly so.

    Example: semantic-mapper map path/to/redkitchen --open
    Example: semantic-mapper map kitchen.mcap --weights kitchen.safetensors
    Example: semantic-mapper map film.mp4 --camera-height 1.5
    """
    must_be_there(*source)
    refuse_options((view and rerun, "--view and --rerun", "show the same; give one of them"))
    from semantic_mapper.fields.weights import load_weights
    from semantic_mapper.replay.map_log import OFFLINE, replay_log

    config = mapper.load(OFFLINE)
    usual = Path("runs") / source[0].resolve().stem
    if out is None and (out := free_name(usual) if is_map(usual) else usual) != usual:
        stderr_console().print(
            f"{usual} holds a map: this one goes to {out}; --out {shlex.quote(str(usual))} replaces it", style="yellow"
        )
    if needs_import(source[0]):
        if len(source) > 1:
            raise typer.BadParameter("of several sources each has to be a part of one log", param_hint="SOURCE")
        if weights is not None:
            load_weights(weights)  # what is wrong with them is said before the long work
        log = out / f"{source[0].resolve().stem}{LOG_SUFFIX}"
        if log.exists() and is_bag(log):
            raise LogError(f"{log}: is a bag, which the log would replace; choose another folder by --out")
        with hold_folder(out):
            reading = ImportOptions(max_frames=max_frames or None)  # the rest would not be mapped
            import_source(output, source[0], log, options, reading=reading, overwrite=True)
        source = [log]
    elif options.given:
        raise typer.BadParameter(
            "a log is mapped as it is; options of `import` go with what is imported", param_hint="SOURCE"
        )
    with StopRequest() as stop, ViewerPage(output) if view else nullcontext() as page:
        with frame_progress("map", None, stop=stop) as bar:
            more = {"rerun": rerun, "watch": page and page.watch, "corrections": corrections, "monitor": bar}
            summary, _ = replay_log(source, out, weights, config, max_frames, **more)
        for line in ending(summary, out):
            output.print(line)
        output.json(summary)
        if open_:
            open_browser((out / "report.html").resolve().as_uri())
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the map so far is in {out}", style="yellow")
        empty = dig(summary, "map.nearly_empty") or not dig(summary, "map.surface_points")
        untrusted = dig(summary, "pose_check.warning") or dig(summary, "depth.computed_too_far")
        untrusted = untrusted and not accept_untrusted
        code = stop.exit_code or (EXIT_EMPTY if empty else EXIT_UNTRUSTED if untrusted else 0)
        if page is not None and not stop:
            stderr_console().print("the page stays until Ctrl-C")
            page.wait(stop)
        return code
