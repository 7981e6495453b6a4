"""``semantic-mapper autolabel``: weights label every frame of a log."""

from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.config import Fraction, load_mapper_config
from semantic_mapper.nodes.cli.info import autolabel_rows
from semantic_mapper.nodes.cli.verb import LISTED, JsonOutput, MaxFramesOption, must_be_there, verb
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.run_folder import prepare_file


@verb
def autolabel(
    output: JsonOutput,
    log: list[Path],  # recorded log (.mcap), the parts of one, or a folder with them
    *,
    weights: Path,  # weights file of any kind, or a name of weights in the package (`rooms`)
    out: Path,  # new log to write (.mcap)
    depth: bool = False,  # also give frames without depth what was computed from the pictures
    min_confidence: Fraction = 0.0,  # pixels that are less sure are unknown
    overwrite_labels: bool = False,  # replace labels that are there, too; without it they stay
    # weights with boxes (`finetune --kind panoptic`): also write CAMERA/NNNNNN.png, ids of boxes in 16 bits, and
    # instances.json
    instances: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    max_frames: MaxFramesOption = 0,
) -> None:
    """Label every frame of a log with weights, into a new log.

    A frame is rendered as `map` and `eval` render it. All else of the log stays: images, poses, stamps, other
    topics, files that it holds, parts. Such pseudo labels, and such depth, are marked: `finetune` learns from them,
    `eval` and `map` never score on them, and computed depth counts as in `map`. Labels that are there stay; those
    of an earlier autolabel are replaced. Ctrl-C leaves nothing (exit code 130).

    Example: semantic-mapper autolabel a.mcap --weights a.safetensors --out b.mcap
    """
    must_be_there(*log)
    from semantic_mapper.replay.autolabel import AutolabelRequest, autolabel_log
    from semantic_mapper.replay.map_log import OFFLINE

    prepare_file(out)
    config = load_mapper_config(None, defaults=OFFLINE)
    request = AutolabelRequest(
        tuple(log), out, weights, config, depth, min_confidence, overwrite_labels, max_frames, instances
    )
    with StopRequest() as stop, frame_progress("autolabel", None, stop=stop) as bar:
        report = autolabel_log(request, bar)
    files, note = [str(file) for file in report.files], report.note
    output.print(", ".join(files))
    if instances is not None:
        output.print(f"  things: {instances}")
    for name, text in autolabel_rows(note.plain()):
        output.print(f"  {name}: {text}")
    output.lines([f"  without a rendering: {line}" for line in report.unlabelled])
    output.lines([f"  damaged, left out: {line}" for line in report.damage])
    if note.kept == note.frames:
        output.print("  note: every frame has a label of its own, which stays; --overwrite-labels replaces them")
    reasons = list(report.unlabelled[:LISTED])
    output.json({"files": files, **note.plain(), "reasons": reasons, "damage": list(report.damage)})
