"""``semantic-mapper finetune``: fit the field to a few labelled keyframes of a log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from semantic_mapper.config import DepthSource, assign, convert_config, load_mapper_config, parse_assignments, read_toml
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.cli.label import frame_numbers
from semantic_mapper.nodes.cli.verb import must_be_there, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.summary import percent
from semantic_mapper.training.config import FinetuneConfig

if TYPE_CHECKING:
    from semantic_mapper.replay.jobs import FinetuneRequest, FinetuneResult


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
        Path | None, typer.Option(help="TOML file with settings of the training; options here go before it.")
    ] = None,
    set: Annotated[  # noqa: A002 - the name of the option
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Any other setting; may be repeated.")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Weights to start from; without it the small ones in the package.")
    ] = None,
    from_scratch: Annotated[
        bool, typer.Option("--from-scratch", hidden=True, help="Start from random weights.")
    ] = False,
    kind: Annotated[
        str | None,
        typer.Option(
            help="Fit a field of this kind to the scene, from all frames; irt: classes of keyframes, panoptic: of "
            "boxes and pseudo labels, grid: none."
        ),
    ] = None,
    frames: Annotated[
        str,
        typer.Option(
            metavar="N,N,...", hidden=True, help="Numbers of the labelled frames in the log, in place of --keyframes."
        ),
    ] = "",
    unlabelled: Annotated[
        int | None,
        typer.Option(
            min=0,
            hidden=True,
            help="--kind, or its weights: frames without labels to use at most; 0 = all.  [default: 300]",
        ),
    ] = None,
    variant: Annotated[
        Literal["B", "BC", "RT", "RTT", "RTC", "RTTC"] | None,
        typer.Option(hidden=True, help="--kind irt, or its weights: what reads the classes.  [default: BC]"),
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
            hidden=True,
            help="--kind panoptic: what is outside of all boxes. stuff: classes that are no things, or that no box "
            "has. empty: nothing.  [default: stuff]",
        ),
    ] = None,
    depth: Annotated[
        DepthSource,
        typer.Option(
            help="auto: the sensor's, and computed from the pictures where the log has none; computed: always; "
            "off: none."
        ),
    ] = "sensor",
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
    Example: semantic-mapper finetune yard.mcap --kind panoptic --boxes boxes.json --out yard.safetensors
    """
    scene = kind is not None
    own_labels = bool(frames) or labels is not None
    refused = (
        (from_scratch and weights is not None, "--weights", "goes with random weights only"),
        (
            scene and (weights is not None or from_scratch),
            "--kind",
            "starts from nothing; leave out --weights and --from-scratch",
        ),
        (kind == "grid" and own_labels, "--frames" if frames else "--labels", "a grid learns no classes"),
        (
            kind == "panoptic" and (keyframes is not None or own_labels),
            "--kind",
            "learns from all frames' pseudo labels; give them with --pseudo",
        ),
        ((boxes is not None) != (kind == "panoptic"), "--boxes", "--kind panoptic and --boxes FILE go together"),
        (
            (pseudo is not None or uncovered is not None) and kind != "panoptic",
            "--uncovered" if pseudo is None else "--pseudo",
            "goes with --kind panoptic only",
        ),
        (
            not own_labels and (keyframes is None) != (kind in ("grid", "panoptic")),
            "--keyframes",
            "how many labelled frames? Only --kind grid learns none",
        ),
        (keyframes is not None and bool(frames), "--keyframes", "--frames already names the frames"),
        (
            unlabelled is not None and not scene and weights is None,
            "--unlabelled",
            "goes with --kind, or --weights of such a kind",
        ),
        (
            variant is not None and kind != "irt" and (scene or weights is None),
            "--variant",
            "goes with --kind irt, or --weights of it",
        ),
        (strokes and kind in ("grid", "panoptic"), "--strokes", f"--kind {kind} learns from no strokes"),
    )
    for wrong, option, why in refused:
        if wrong:
            raise typer.BadParameter(why, param_hint=option)
    must_be_there(log)
    output = Output.guarded()
    from semantic_mapper.replay.jobs import OFFLINE, FinetuneRequest, finetune_log
    from semantic_mapper.training.finetune import FITTERS

    if kind is not None and kind not in FITTERS:
        raise typer.BadParameter(
            f"no kind '{kind}' is fitted to one scene; there is {', '.join(FITTERS)}", param_hint="--kind"
        )
    data = read_toml(config) if config is not None else {}
    given = {"seconds": seconds, "steps": steps, "seed": seed, "irt.variant": variant}
    given |= parse_assignments(set or ())
    for name, value in given.items():
        if value is not None:
            assign(data, name, value, "--set")
    settings = convert_config(data, FinetuneConfig, str(config) if config is not None else "settings of the finetuning")
    if settings.seconds == 0 and settings.steps == 0:
        raise typer.BadParameter("give --seconds, --steps, or both", param_hint="--seconds")
    keep_freed_memory()
    depths = load_mapper_config(None, {"depth.source": depth}, OFFLINE).depth
    request = FinetuneRequest(
        log,
        out,
        keyframes=keyframes or 0,
        config=settings,
        weights=weights,
        from_scratch=from_scratch,
        depth=depths,
        kind=kind,
        labels=labels,
        frames=frame_numbers(frames),
        unlabelled=unlabelled,
        boxes=boxes,
        pseudo=pseudo,
        uncovered=uncovered or "stuff",
        strokes=strokes,
    )
    with StopRequest() as stop, frame_progress("finetune", None, unit="%", stop=stop) as bar:
        result = finetune_log(request, bar)
    for line in finetune_lines(result, request):
        output.print(line)
    if stop:
        stderr_console().print(f"stopped by {stop.name}; the best weights so far are in {out}", style="yellow")
    return stop.exit_code


def finetune_lines(result: FinetuneResult, request: FinetuneRequest) -> list[str]:
    """What was learned, for a reader."""
    checkpoint, chosen = result.checkpoint, result.chosen
    recipe, out, log = checkpoint.recipe, request.out, request.log.name
    lines = [f"{out}: finetuned on frames {', '.join(map(str, chosen))} of {log}"] if chosen else []
    if "psnr" in recipe:
        psnr = "no held-out views rendered" if recipe["psnr"] is None else f"held-out views {recipe['psnr']:.1f} dB"
        steps = recipe.get("grid_steps", recipe["steps"])
        lines.append(f"{out}: grid of {log}, {steps} steps in {recipe['seconds']} s, {psnr}")
    if "held_out_loss" in recipe:
        lines.append(
            f"  {recipe['steps']} steps in {recipe['seconds']} s, best at step {recipe['best_step']}: held-out loss "
            f"{recipe['held_out_loss']:.3f}, accuracy {recipe['held_out_accuracy'] * 100:.1f} %"
        )
    if pseudo := recipe.get("pseudo_labels"):
        by = f" that {pseudo['of']} has rendered" if pseudo["of"] else ""
        lines.append(
            f"  {pseudo['keyframes']} of the {len(chosen)} keyframes have pseudo labels{by}: the figures above say how "
            "well these are learned, not how right they are"
        )
    if grown := recipe.get("strokes"):
        lines.append(
            f"  strokes of {percent(grown['painted'])} of the keyframes' pixels have grown to {percent(grown['grown'])}"
        )
    if own := recipe.get("own_view"):
        lines.append(
            f"  a frame's own image counts {own['factor']:g} times among the views, "
            f"{own['factor_without_depth']:g} times where there is no depth"
        )
    if boxed := recipe.get("panoptic"):
        lines.append(
            f"  {boxed['seen']} of {boxed['boxes']} boxes seen; pixels that meet one {percent(boxed['covered'])}; "
            f"pseudo labels ({boxed['pseudo']}) of {boxed['labelled_frames']} of {boxed['frames']} frames, matched "
            f"{percent(boxed['matched'])}"
        )
        if checkpoint.model.config.classes == "fixed":
            lines.append(
                "  stopped before classes were learned: they are those of the boxes alone; what is in none of them "
                "(wall or floor) is not separated"
            )
        if boxed["moving"]:
            lines.append(f"  {boxed['moving']} boxes that move, with grids of their own")
        if left_out := [text for count, text in _left_out(boxed) if count]:
            lines.append(f"  boxes left out: {'; '.join(left_out)}")
    if checkpoint.model.holds_scene:
        lines.append(f"  {out.stat().st_size / 1e6:.1f} MB that show the scene: as private as the recording")
    return lines


def _left_out(boxed: Mapping[str, Any]) -> list[tuple[int, str]]:
    """How many boxes were left out, for which reason."""
    reasons = {
        "unseen": "that no frame sees",
        "lost": "that move, which no frame shows at their times",
        "left_out": "of no class, or of one that the labels lack",
    }
    return [(boxed[name], f"{boxed[name]} {reason}") for name, reason in reasons.items()]
