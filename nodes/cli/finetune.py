"""``semantic-mapper finetune``: fit the field to a few labelled keyframes of a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.cli.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.cli.label import frame_numbers
from semantic_mapper.nodes.cli.verb import must_be_there, verb
from semantic_mapper.nodes.process import StopRequest

FinetuneDepthOption = Annotated[
    Literal["auto", "sensor", "computed", "off"] | None,
    typer.Option(
        "--depth",
        help="auto: the sensor's, and computed from the pictures where the log has none; computed: always; off: none.  "
        "[default: sensor]",
    ),
]


@verb
def finetune(
    log: Annotated[Path, typer.Argument(help="Log with label images (.mcap).")],
    out: Annotated[Path, typer.Option("--out", help="Weights file to write (.safetensors).")],
    keyframes: Annotated[
        int | None, typer.Option("--keyframes", min=2, help="How many labelled frames to use; none for --kind grid.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Time for training [300]; 0 = only --steps counts.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps of training; 0 = only --seconds counts.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of everything that is drawn at random [0].")] = None,
    config: Annotated[
        Path | None, typer.Option(help="TOML file with a FinetuneConfig; options here go before it.")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Weights to start from; without it the small ones in the package.")
    ] = None,
    from_scratch: Annotated[bool, typer.Option("--from-scratch", help="Start from random weights.")] = False,
    kind: Annotated[
        str | None,
        typer.Option(
            help="Fit a field of this kind to the scene, from all frames; irt: classes of keyframes, panoptic: of "
            "boxes and pseudo labels, grid: none."
        ),
    ] = None,
    frames: Annotated[
        str, typer.Option(metavar="N,N,...", help="Numbers of the labelled frames in the log, in place of --keyframes.")
    ] = "",
    unlabelled: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="--kind, or its weights: frames without labels to use at most; 0 = all.  [default: 300]",
        ),
    ] = None,
    variant: Annotated[
        Literal["B", "BC", "RT", "RTT", "RTC", "RTTC"] | None,
        typer.Option(help="--kind irt, or its weights: what reads the classes.  [default: BC]"),
    ] = None,
    boxes: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="--kind panoptic: boxes.json, the JSON of `query MAP instances`, or XML of KITTI-360.",
        ),
    ] = None,
    pseudo: Annotated[
        str | None,
        typer.Option(
            metavar="DIR|WEIGHTS",
            help="--kind panoptic: pseudo labels, a folder of NNNNNN.png or weights that make them; without it the "
            "log's own label images, else the small weights in the package.",
        ),
    ] = None,
    uncovered: Annotated[
        Literal["stuff", "empty"] | None,
        typer.Option(
            help="--kind panoptic: what is outside of all boxes. stuff: classes that are no things, or that no box "
            "has. empty: nothing.  [default: stuff]"
        ),
    ] = None,
    depth: FinetuneDepthOption = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Label images NNNNNN.png in place of the log's, as `label --serve` writes them; all of them without "
            "--keyframes. Unlabelled pixels count for nothing.",
        ),
    ] = None,
    strokes: Annotated[
        bool,
        typer.Option(
            "--strokes", help="Labels are strokes: let each grow over what looks like it, as the labelling page shows."
        ),
    ] = False,
) -> int:
    """Fit the field to a few labelled keyframes of a log.

    The keyframes are those that together show most of what the log shows; no other label is trained on. The weights
    remember them, so that `replay` and `eval` never score on them; of pseudo labels (`autolabel`), also the keyframes
    of the weights that rendered these. With --depth computed the
    keyframes have depth computed from the log's pictures. Ctrl-C writes the best weights so far (exit code 130).

    Example: semantic-mapper finetune kitchen.mcap --keyframes 8 --seconds 480 --out kitchen.safetensors
    Example: semantic-mapper finetune kitchen.mcap --labels kitchen-labels --strokes --out kitchen.safetensors
    Example: semantic-mapper finetune kitchen.mcap --kind irt --keyframes 4 --out kitchen.safetensors
    Example: semantic-mapper finetune yard.mcap --kind panoptic --boxes boxes.json --out yard.safetensors
    """
    _refuse_mixed(weights, from_scratch, kind, keyframes, frames, labels, unlabelled, variant, boxes, pseudo, uncovered)
    if strokes and kind in ("grid", "panoptic"):
        raise typer.BadParameter(f"--kind {kind} learns from no strokes", param_hint="--strokes")
    must_be_there(log)
    output = Output.guarded()
    import msgspec

    from semantic_mapper.config import load_config
    from semantic_mapper.nodes.cli.run_finetune import FinetuneRequest, finetune_lines, finetune_log
    from semantic_mapper.nodes.cli.run_replay import REPLAY_DELAY_FRAMES, mapper_config
    from semantic_mapper.training.finetune import FinetuneConfig
    from semantic_mapper.training.fitters import FITTERS

    if kind is not None and kind not in FITTERS:
        raise typer.BadParameter(
            f"no kind '{kind}' is fitted to one scene; there is {', '.join(FITTERS)}", param_hint="--kind"
        )
    given = {"seconds": seconds, "steps": steps, "seed": seed}
    settings = load_config(config, FinetuneConfig) if config is not None else FinetuneConfig()
    settings = msgspec.structs.replace(settings, **{name: v for name, v in given.items() if v is not None})
    if variant is not None:
        settings = msgspec.structs.replace(settings, irt=msgspec.structs.replace(settings.irt, variant=variant))
    if settings.seconds == 0 and settings.steps == 0:
        raise typer.BadParameter("give --seconds, --steps, or both", param_hint="--seconds")
    keep_freed_memory()
    depths = mapper_config(None, None, depth=depth or "sensor", delay_frames=REPLAY_DELAY_FRAMES).depth
    request = FinetuneRequest(
        log,
        keyframes or 0,
        out,
        settings,
        weights,
        from_scratch,
        depths,
        kind,
        labels,
        frame_numbers(frames),
        unlabelled,
        boxes,
        pseudo,
        uncovered or "stuff",
        strokes,
    )
    with StopRequest() as stop, frame_progress("finetune", None, unit="%") as bar:
        checkpoint, chosen = finetune_log(request, stop, bar)
    for line in finetune_lines(checkpoint, chosen, request):
        output.print(line)
    if stop:
        stderr_console().print(f"stopped by {stop.name}; the best weights so far are in {out}", style="yellow")
    return stop.exit_code


def _refuse_mixed(
    weights: Path | None,
    from_scratch: bool,
    kind: str | None,
    keyframes: int | None,
    frames: str,
    labels: Path | None,
    unlabelled: int | None,
    variant: str | None,
    boxes: Path | None,
    pseudo: str | None,
    uncovered: str | None,
) -> None:
    """Refuse options that do not go together.

    Raises:
        typer.BadParameter: which, and why.
    """
    if from_scratch and weights is not None:
        raise typer.BadParameter("goes with random weights only", param_hint="--weights")
    if kind is not None and (weights is not None or from_scratch):
        raise typer.BadParameter("starts from nothing; leave out --weights and --from-scratch", param_hint="--kind")
    if kind == "grid" and (frames or labels is not None):
        raise typer.BadParameter("a grid learns no classes", param_hint="--frames" if frames else "--labels")
    if kind == "panoptic" and (keyframes is not None or frames or labels is not None):
        raise typer.BadParameter("learns from all frames' pseudo labels; give them with --pseudo", param_hint="--kind")
    if (boxes is not None) != (kind == "panoptic"):
        raise typer.BadParameter("--kind panoptic and --boxes FILE go together", param_hint="--boxes")
    if (pseudo is not None or uncovered is not None) and kind != "panoptic":
        raise typer.BadParameter(
            "goes with --kind panoptic only", param_hint="--uncovered" if pseudo is None else "--pseudo"
        )
    if not frames and labels is None and (keyframes is None) != (kind in ("grid", "panoptic")):
        raise typer.BadParameter("how many labelled frames? Only --kind grid learns none", param_hint="--keyframes")
    if keyframes is not None and frames:
        raise typer.BadParameter("--frames already names the frames", param_hint="--keyframes")
    if unlabelled is not None and kind is None and weights is None:
        raise typer.BadParameter("goes with --kind, or --weights of such a kind", param_hint="--unlabelled")
    if variant is not None and kind != "irt" and (kind is not None or weights is None):
        raise typer.BadParameter("goes with --kind irt, or --weights of it", param_hint="--variant")
