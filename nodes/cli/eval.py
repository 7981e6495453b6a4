"""``semantic-mapper eval``: figures of replays side by side, or of a log by several methods."""

from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.config import AtLeastZero
from semantic_mapper.errors import ConfigError
from semantic_mapper.files import write_json
from semantic_mapper.nodes.cli.verb import (
    JsonOutput,
    MapperSettings,
    MaxFramesOption,
    WeightsOption,
    must_be_there,
    refuse_options,
    verb,
)
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.replay.evaluate.mesh_surface import compare_with_mesh
from semantic_mapper.replay.evaluate.report import score_table, write_eval_report
from semantic_mapper.replay.run_folder import MAP_SUFFIX, is_log, prepare_file
from semantic_mapper.replay.summary import notes, percent, read_summary, summary_table


@verb
def evaluate(
    output: JsonOutput,
    mapper: MapperSettings,
    # folders of `map`; logs, or folders with their parts
    targets: Annotated[list[Path], typer.Argument(metavar="DIR|LOG")],
    *,
    weights: WeightsOption = None,
    baselines: bool = False,  # LOG: also fit baselines to the keyframes
    seconds: AtLeastZero = 300.0,  # --baselines: to train the U-Net
    mesh: Path | None = None,  # DIR: a reference mesh (.npz) to compare with
    # LOG: true objects, [CAMERA/]NNNNNN.png, for panoptic quality
    instances: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    max_frames: MaxFramesOption = 0,
    out: Path | None = None,  # JSON [DIR/eval.json or LOG.eval.json]
) -> None:
    """Score logs, and results of `map`: figures, and a page.

    A DIR gives the figures of its `map`. A LOG is mapped and scored; keyframes of its weights never count. --baselines
    adds a per-image U-Net and labels carried over by depth, made from those keyframes. Writes JSON, and HTML next to
    it.

    Example: semantic-mapper eval runs/a runs/b
    Example: semantic-mapper eval a.mcap --weights a.safetensors --baselines
    Example: semantic-mapper eval kitchen.mcap --instances kitchen/instance
    """
    if out is not None and out.is_file() and out.suffix != ".json":  # weights, say, that were named by mistake
        raise typer.BadParameter(f"{out} is there and does not end in .json; results would replace it")
    must_be_there(*targets)
    for target in targets:
        if target.suffix == MAP_SUFFIX:
            raise ConfigError(f"{target}: is a map alone; give the folder with its summary.json, or a log")
    logs = [t for t in targets if is_log(t) or not t.is_dir()]
    folders = [t for t in targets if t not in logs]
    refuse_options(
        (baselines and seconds == 0, "--seconds", "the U-Net needs time to learn"),
        (mesh is not None and not folders, "--mesh", "goes with a DIR that `map` has written"),
        (instances is not None and not logs, "--instances", "goes with a LOG"),
    )
    path = out or (folders[0] / "eval.json" if folders else targets[0].with_suffix(".eval.json"))
    prepare_file(path)
    summaries = {str(folder): read_summary(folder) for folder in folders}
    if summaries:
        output.print(summary_table(summaries))
    for name, summary in summaries.items():
        output.lines([f"{name}: {note}" for note in notes(summary)])
    found: dict[str, Any] = {"replays": summaries, "logs": {}}
    if mesh is not None:
        found["surface"] = {str(f): compare_with_mesh(f, mesh) for f in folders}
        for name, figures in found["surface"].items():
            output.print(f"{name}: {_surface_line(figures)}")
    from semantic_mapper.replay.evaluate_log import evaluate_log

    settings = mapper.load()
    for log in logs:
        with frame_progress("score", None) as bar:
            baseline_s = seconds if baselines else 0.0
            scores = evaluate_log(
                log, weights, settings, max_frames, baseline_s=baseline_s, instances=instances, monitor=bar
            ).plain()
        found["logs"][str(log)] = scores
        output.print(score_table(log.name, scores))
    write_json(path, found)
    write_eval_report(page := path.with_suffix(".html"), found, folders)
    output.print(f"written to {path} and, for a browser, {page}")
    output.json(found)


def _surface_line(figures: dict[str, Any]) -> str:
    """One sentence about a map and a mesh."""
    labels = "" if figures["mesh_miou"] is None else f", mIoU at its vertices {percent(figures['mesh_miou'])}"
    return (
        f"surface {figures['median_m'] * 1000:.1f} mm (median) from the mesh, {percent(figures['complete'])} of the "
        f"mesh within 5 cm of the map, {percent(figures['complete_10cm'])} within 10 cm{labels}"
    )
