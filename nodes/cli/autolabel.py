"""``semantic-mapper autolabel``: weights label every frame of a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.config import load_mapper_config
from semantic_mapper.nodes.cli.info import autolabel_rows
from semantic_mapper.nodes.cli.options import MaxFramesOption
from semantic_mapper.nodes.cli.verb import JsonOption, must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.run_folder import prepare_file

LISTED = 10  # frames without a label, and damages, that are shown one by one


@verb
def autolabel(
    log: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Recorded log (.mcap), the parts of one, or a folder with them."),
    ],
    weights: Annotated[
        Path, typer.Option("--weights", help="Weights file of any kind, or a name of weights in the package (`rooms`).")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="NEW", help="New log to write (.mcap).")],
    depth: Annotated[
        bool,
        typer.Option("--depth", help="Also give frames without depth what was computed from the pictures."),
    ] = False,
    min_confidence: Annotated[
        float, typer.Option("--min-confidence", min=0, max=1, help="Pixels that are less sure are unknown.")
    ] = 0.0,
    overwrite_labels: Annotated[
        bool, typer.Option("--overwrite-labels", help="Replace labels that are there, too; without it they stay.")
    ] = False,
    instances: Annotated[
        Path | None,
        typer.Option(
            "--instances",
            metavar="DIR",
            help="Weights with boxes (`finetune --kind panoptic`): also write CAMERA/NNNNNN.png, ids of boxes in 16 "
            "bits, and instances.json.",
        ),
    ] = None,
    max_frames: MaxFramesOption = 0,
    json: JsonOption = False,
) -> int:
    """Label every frame of a log with weights, into a new log.

    A frame is rendered as `replay` and `eval` render it. All else of the log stays: images, poses, stamps, other
    topics, files that it holds, parts. Such pseudo labels, and such depth, are marked: `finetune` learns from them,
    `eval` and `replay` never score on them, and computed depth counts as in `replay`. Labels that are there stay; those
    of an earlier autolabel are replaced. Ctrl-C leaves nothing (exit code 130).

    Example: semantic-mapper autolabel kitchen.mcap --weights kitchen.safetensors --out labelled.mcap
    """
    must_be_there(*log)
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.replay.jobs import OFFLINE, AutolabelRequest, autolabel_log

    prepare_file(out)
    config = load_mapper_config(None, defaults=OFFLINE)
    request = AutolabelRequest(
        tuple(log), out, weights, config, depth, min_confidence, overwrite_labels, max_frames, instances
    )
    with StopRequest() as stop, frame_progress("autolabel", None, stop=stop) as bar:
        report = autolabel_log(request, bar)
    found: dict[str, Any] = {
        "files": [str(file) for file in report.files],
        **report.note.plain(),
        "reasons": list(report.unlabelled[:LISTED]),
        "damage": list(report.damage),
    }
    output.print(", ".join(found["files"]))
    if instances is not None:
        output.print(f"  things: {instances}")
    for name, text in autolabel_rows(found):
        output.print(f"  {name}: {text}")
    for what, lines in (("without a rendering", report.unlabelled), ("damaged, left out", report.damage)):
        for line in lines[:LISTED]:
            output.print(f"  {what}: {line}")
        if len(lines) > LISTED:
            output.print(f"  and {len(lines) - LISTED} more")
    if report.note.kept == report.note.frames:
        output.print("  note: every frame has a label of its own, which stays; --overwrite-labels replaces them")
    if json:
        output.json(found)
    return 0
