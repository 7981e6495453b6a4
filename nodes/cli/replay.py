"""``semantic-mapper replay``: a recording becomes a map, in this process."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.nodes.cli.film import FilmFlags, RotateOption
from semantic_mapper.nodes.cli.importing import import_source
from semantic_mapper.nodes.cli.options import MapperSettings, MaxFramesOption, OutOption, WeightsOption
from semantic_mapper.nodes.cli.verb import EXIT_UNTRUSTED, must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.run_folder import LOG_SUFFIX, hold_folder, is_log
from semantic_mapper.replay.summary import dig, notes, result_lines, summary_table


@verb
def replay(
    source: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="Recorded log (.mcap), the parts of one, or a folder with them; or a film, pictures or recording that "
            "`import` takes.",
        ),
    ],
    out: OutOption,
    mapper: MapperSettings,
    film: FilmFlags,
    weights: WeightsOption = None,
    max_frames: MaxFramesOption = 0,
    rotate: RotateOption = "0",
    eval_exclude: Annotated[
        Path | None,
        typer.Option(hidden=True, help="Leave frames that these weights were finetuned on out of the scores, too."),
    ] = None,
    rerun: Annotated[Path | None, typer.Option(help="Also write a Rerun recording (.rrd).")] = None,
    corrections: Annotated[
        Path | None,
        typer.Option(help="Corrected poses (TUM: stamp tx ty tz qx qy qz qw); the map moves to them at the end."),
    ] = None,
    accept_contradictions: Annotated[
        bool,
        typer.Option(
            "--accept-contradictions",
            hidden=True,
            help="Exit code 0 although poses and depth contradict each other (else 3).",
        ),
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the summary as JSON, and nothing else, on stdout.")
    ] = False,
) -> int:
    """Map a recording: a log, a film, or a folder or bag that `import` takes.

    Writes report.html, summary.json, map.ply, map.npz and overview.png. What is no log is imported first, to a log in
    OUT; one without depth images is mapped with the weights that have learned from computed depth.

    Frames that the weights were finetuned on are mapped, but never scored. Damaged or impossible frames are refused
    with the reason; the rest is mapped. Ctrl-C still writes the map of the frames so far (exit code 130).
    Where poses and depth contradict each other, the map is written and the exit code is 3.

    Example: semantic-mapper replay kitchen.mcap --out runs/kitchen --weights kitchen.safetensors
    Example: semantic-mapper replay film.mp4 --out runs/film --calibration camera.toml --camera-height 1.5
    """
    must_be_there(*source)
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.fields.checkpoint import COMPUTED_DEPTH, load_checkpoint
    from semantic_mapper.replay.jobs import OFFLINE, replay_log

    config = mapper.load(OFFLINE)
    if not is_log(source[0]):
        if len(source) > 1:
            raise typer.BadParameter("of several sources each has to be a part of one log", param_hint="SOURCE")
        if weights is not None:
            load_checkpoint(weights)  # what is wrong with them is said before the long work
        log = out / f"{source[0].resolve().stem}{LOG_SUFFIX}"
        with hold_folder(out):
            with_depth = import_source(output, source[0], log, film, int(rotate) // 90, overwrite=True)
        source, weights = [log], weights or (None if with_depth else COMPUTED_DEPTH)
    elif film.given() or rotate != "0":
        raise typer.BadParameter("a log is mapped as it is; options of films go with films", param_hint="SOURCE")
    more = {"exclude": eval_exclude, "rerun": rerun, "corrections": corrections}
    with StopRequest() as stop:
        with frame_progress("replay", None, stop=stop) as bar:
            summary = replay_log(source, out, weights, config, max_frames, **more, monitor=bar).summary
        show_replay(output, summary, out)
        if json:
            output.json(summary)
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the map so far is in {out}", style="yellow")
        untrusted = dig(summary, "pose_check.warning") and not accept_contradictions
        empty = not dig(summary, "map.surface_points")
        return stop.exit_code or (EXIT_UNTRUSTED if untrusted or empty else 0)


def show_replay(output: Output, summary: Mapping[str, Any], out: Path) -> None:
    """Table, notes and files of one replay, for people."""
    output.print(summary_table({out.name: summary}))
    for line in (*notes(summary), *result_lines(out)):
        output.print(line)
