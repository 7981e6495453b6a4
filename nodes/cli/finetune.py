"""``semantic-mapper finetune``: fit the field to a few labelled keyframes of a log."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import typer

from semantic_mapper.config import AtLeastTwo, DepthSource, load_mapper_config
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.cli.verb import SettingOptions, must_be_there, refuse_options, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.summary import percent
from semantic_mapper.training.config import FinetuneConfig


class FinetuneSettings(SettingOptions):
    """Settings of the training."""

    kind = FinetuneConfig
    options: ClassVar = {"--seconds": "seconds", "--steps": "steps", "--seed": "seed"}


@verb
def finetune(
    output: Output,
    log: Path,  # log with label images (.mcap)
    training: FinetuneSettings,
    *,
    out: Path,  # weights file to write (.safetensors)
    keyframes: AtLeastTwo | None = None,  # how many labelled frames to use
    weights: Path | None = None,  # to start from, in place of the package's
    # of this scene alone; classes of keyframes (irt), of boxes (panoptic), or none (grid)
    kind: Literal["irt", "panoptic", "grid"] | None = None,
    boxes: Path | None = None,  # panoptic: a file of boxes
    # panoptic: in place of the log's labels
    pseudo: Annotated[str | None, typer.Option(metavar="DIR|WEIGHTS")] = None,
    uncovered: Literal["stuff", "empty"] = "stuff",  # panoptic: outside of all boxes
    depth: DepthSource = "sensor",  # as of `map`
    # NNNNNN.png of `label --serve` in place of the log's; all of them without --keyframes
    labels: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    strokes: bool = False,  # labels are strokes: let each grow
) -> int:
    """Fit weights to a few labelled keyframes of a log.

    The keyframes are those that together show most of the log; no other label is trained on, and `map` and `eval`
    never score on them. Ctrl-C writes the best weights so far (exit code 130). See docs/scenes.md.

    Example: semantic-mapper finetune a.mcap --keyframes 8 --out a.safetensors
    Example: semantic-mapper finetune a.mcap --labels a-labels --out a.safetensors
    Example: semantic-mapper finetune a.mcap --kind grid --out a.safetensors
    """
    without_labels = kind in ("grid", "panoptic")
    refuse_options(
        (kind is not None and weights is not None, "--kind", "starts from nothing; leave out --weights"),
        ((boxes is not None) != (kind == "panoptic"), "--boxes", "--kind panoptic and --boxes FILE go together"),
        (pseudo is not None and kind != "panoptic", "--pseudo", "goes with --kind panoptic only"),
        (without_labels and (labels or keyframes or strokes), "--kind", f"{kind} learns from no keyframes and strokes"),
        (not without_labels and labels is None and keyframes is None, "--keyframes", "how many labelled frames?"),
    )
    must_be_there(log)
    settings = training.convert(FinetuneConfig)
    if settings.seconds == 0 and settings.steps == 0:
        raise typer.BadParameter("give --seconds, --steps, or both", param_hint="--seconds")
    from semantic_mapper.replay.finetune_log import FinetuneRequest, finetune_log
    from semantic_mapper.replay.map_log import OFFLINE

    keep_freed_memory()
    request = FinetuneRequest(
        log,
        out,
        keyframes=keyframes or 0,
        config=settings,
        weights=weights,
        depth=load_mapper_config(None, {"depth.source": depth}, OFFLINE).depth,
        kind=kind,
        labels=labels,
        boxes=boxes,
        pseudo=pseudo,
        uncovered=uncovered,
        strokes=strokes,
    )
    with StopRequest() as stop, frame_progress("finetune", None, unit="%", stop=stop) as bar:
        checkpoint, chosen = finetune_log(request, bar)
    if chosen:
        output.print(f"{out}: finetuned on frames {', '.join(map(str, chosen))} of {log.name}")
    for line in _recipe_lines(checkpoint.recipe, len(chosen)):
        output.print(f"  {line}")
    if checkpoint.model.holds_scene:
        size = f"{out.stat().st_size / 1e6:.1f} MB"
        output.print(f"{out}: {size} that show the scene of {log.name}: as private as the recording")
    if stop:
        stderr_console().print(f"stopped by {stop.name}; the best weights so far are in {out}", style="yellow")
    return stop.exit_code


def _recipe_lines(recipe: dict[str, Any], chosen: int) -> list[str]:
    lines: list[str] = []
    if "psnr" in recipe:
        psnr = "no held-out views rendered" if recipe["psnr"] is None else f"held-out views {recipe['psnr']:.1f} dB"
        lines.append(f"grid: {recipe.get('grid_steps', recipe['steps'])} steps in {recipe['seconds']} s, {psnr}")
    if "held_out_loss" in recipe:
        lines.append(
            f"{recipe['steps']} steps in {recipe['seconds']} s, best at step {recipe['best_step']}: held-out loss "
            f"{recipe['held_out_loss']:.3f}, accuracy {recipe['held_out_accuracy'] * 100:.1f} %"
        )
    if pseudo := recipe.get("pseudo_labels"):
        by = f" that {pseudo['of']} has rendered" if pseudo["of"] else ""
        lines.append(
            f"{pseudo['keyframes']} of the {chosen} keyframes have pseudo labels{by}: the figures above say how "
            "well these are learned, not how right they are"
        )
    if grown := recipe.get("strokes"):
        lines.append(
            f"strokes of {percent(grown['painted'])} of the keyframes' pixels have grown to {percent(grown['grown'])}"
        )
    if boxed := recipe.get("panoptic"):
        lines.append(
            f"{boxed['seen']} of {boxed['boxes']} boxes seen; pixels that meet one {percent(boxed['covered'])}; "
            f"pseudo labels ({boxed['pseudo']}) of {boxed['labelled_frames']} of {boxed['frames']} frames, matched "
            f"{percent(boxed['matched'])}"
        )
        left_out = {"unseen": "that no frame sees", "lost": "that move, which no frame shows at their times"}
        if any(boxed[name] for name in left_out):
            reasons = (f"{boxed[name]} {reason}" for name, reason in left_out.items() if boxed[name])
            lines.append(f"boxes left out: {'; '.join(reasons)}")
    return lines
