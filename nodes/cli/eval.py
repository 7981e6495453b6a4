"""``semantic-mapper eval``: figures of replays side by side, of a log by several methods, or of two runs of one log."""

from pathlib import Path
from typing import Annotated, Any

import typer

from semantic_mapper.config import AtLeastZero
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.files import write_json
from semantic_mapper.nodes.cli.verb import (
    EXIT_FAILED,
    JsonOutput,
    MapperSettings,
    MaxFramesOption,
    WeightsOption,
    must_be_there,
    refuse_options,
    verb,
    wrong_usage,
)
from semantic_mapper.nodes.console import frame_progress
from semantic_mapper.replay.compare import Tolerances, compare_runs, read_run
from semantic_mapper.replay.evaluate.mesh_surface import compare_with_mesh
from semantic_mapper.replay.evaluate.report import score_table, write_eval_report
from semantic_mapper.replay.run_folder import MAP_SUFFIX, is_log, prepare_file
from semantic_mapper.replay.summary import notes, percent, read_summary, summary_table

_SAME = Tolerances()


@verb
def evaluate(
    output: JsonOutput,
    mapper: MapperSettings,
    # folders of `map`; logs, or their folders
    targets: Annotated[list[Path], typer.Argument(metavar="DIR|LOG")],
    *,
    weights: WeightsOption = None,
    baselines: AtLeastZero = 0.0,  # LOG: seconds to fit baselines in; 0 = none
    mesh: Path | None = None,  # DIR: a reference mesh (.npz) to compare with
    # LOG: true objects, [CAMERA/]NNNNNN.png
    instances: Annotated[Path | None, typer.Option(metavar="DIR")] = None,
    max_frames: MaxFramesOption = 0,
    out: Path | None = None,  # JSON [DIR/eval.json or LOG.eval.json]
    # DIR: another result, to come to the same
    against: Annotated[Path | None, typer.Option(metavar="DIR|map.npz")] = None,
    score: AtLeastZero = _SAME.score,  # --against: allowed of scores
    surface_m: AtLeastZero = _SAME.surface_m,  # --against: allowed, metres
    labels: AtLeastZero = _SAME.labels,  # --against: allowed of classes
) -> int:
    """Score logs and results of `map`, or compare two results.

    A DIR gives the figures of its `map`. A LOG is mapped and scored; keyframes of its weights never count. --baselines
    adds a per-image U-Net and labels carried over by depth, made from those. Writes JSON and HTML. --against
    writes nothing; exit code 1 where scores or surfaces differ.

    Example: semantic-mapper eval runs/a runs/b
    Example: semantic-mapper eval a.mcap --weights a.safetensors --baselines 300
    Example: semantic-mapper eval runs/after --against runs/before --labels 0.05
    """
    tolerances = Tolerances(score=score, surface_m=surface_m, labels=labels)
    logs = [] if against else [t for t in targets if is_log(t) or not t.is_dir()]
    of_logs = {
        "--weights": weights,
        "--baselines": baselines,
        "--instances": instances,
        "--max-frames": max_frames,
        "settings of the mapper": mapper.path or mapper.given,
    }
    refuse_options(
        *((value and not logs, name, "goes with a LOG") for name, value in of_logs.items()),
        (against and (mesh or out), "--mesh, --out", "do not go with --against"),
        (tolerances != _SAME and not against, "--score, --surface-m, --labels", "go with --against"),
        (against and len(targets) > 1, "--against", "compares one result with another"),
    )
    if against:
        return _compare(output, targets[0], against, tolerances)
    if out is not None and out.is_file() and out.suffix != ".json":  # weights, say, that were named by mistake
        raise typer.BadParameter(f"{out} is there and does not end in .json; results would replace it")
    must_be_there(*targets)
    for target in targets:
        if target.suffix == MAP_SUFFIX:
            raise ConfigError(f"{target}: is a map alone; give the folder with its summary.json, or a log")
    folders = [t for t in targets if t not in logs]
    refuse_options((mesh is not None and not folders, "--mesh", "goes with a DIR that `map` has written"))
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
            scores = evaluate_log(
                log, weights, settings, max_frames, baseline_s=baselines, instances=instances, monitor=bar
            ).plain()
        found["logs"][str(log)] = scores
        output.print(score_table(log.name, scores))
    write_json(path, found)
    write_eval_report(page := path.with_suffix(".html"), found, folders)
    output.print(f"written to {path} and, for a browser, {page}")
    output.json(found)
    return 0


def _compare(output: JsonOutput, a: Path, b: Path, tolerances: Tolerances) -> int:
    """Print what differs between two results of one log; the exit code."""
    with wrong_usage(SemanticMapperError):
        comparison = compare_runs(read_run(a), read_run(b), tolerances)
    for line in (*comparison.figures, *comparison.notes):
        output.print(str(line))
    different = ", ".join(figure.name for figure in comparison.differences)
    output.print(f"different: {different}" if different else "equal")
    output.json({"a": str(a), "b": str(b), **comparison.to_plain()})
    return 0 if comparison.equal else EXIT_FAILED


def _surface_line(figures: dict[str, Any]) -> str:
    labels = "" if figures["mesh_miou"] is None else f", mIoU at its vertices {percent(figures['mesh_miou'])}"
    return (
        f"surface {figures['median_m'] * 1000:.1f} mm (median) from the mesh, {percent(figures['complete'])} of the "
        f"mesh within 5 cm of the map, {percent(figures['complete_10cm'])} within 10 cm{labels}"
    )
