"""``semantic-mapper eval``: figures of replays side by side, or of a log by several methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import write_json
from semantic_mapper.nodes.cli.options import MapperSettings, MaxFramesOption
from semantic_mapper.nodes.cli.verb import JsonOption, must_be_there, results_file, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.replay.evaluate.mesh_surface import compare_with_mesh
from semantic_mapper.replay.evaluate.report import score_table, write_eval_report
from semantic_mapper.replay.run_folder import MAP_SUFFIX, is_log, prepare_file
from semantic_mapper.replay.summary import notes, read_summary, result_lines, summary_table

BASELINE_SECONDS = 300.0

TargetsArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="DIR_OR_LOG...", help="Folders that `replay` has written; logs, or folders with their parts."
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", help="JSON; else eval.json in the first DIR, or LOG.eval.json."),
]
WeightsOption = Annotated[
    Path | None,
    typer.Option("--weights", help="LOG: weights file; the one in the package without it."),
]
BaselinesOption = Annotated[
    bool, typer.Option("--baselines", help="LOG: also fit the baselines to the keyframes of the weights.")
]
MeshOption = Annotated[
    Path | None, typer.Option(metavar="NPZ", help="DIR: also compare its map with this reference mesh.")
]
InstancesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="LOG: images of its frames' true objects, NNNNNN.png or CAMERA/NNNNNN.png (8 or 16 bits, 0 = none): also "
        "score the finished map with its things by panoptic quality, and so weights with boxes with theirs.",
    ),
]
SecondsOption = Annotated[
    float | None, typer.Option(min=0, help="--baselines: training time of the U-Net.  [default: 300]")
]


@verb
def evaluate(
    mapper: MapperSettings,
    targets: TargetsArgument = None,
    weights: WeightsOption = None,
    baselines: BaselinesOption = False,
    seconds: SecondsOption = None,
    mesh: MeshOption = None,
    instances: InstancesOption = None,
    max_frames: MaxFramesOption = 0,
    out: OutOption = None,
    json: JsonOption = False,
) -> int:
    """Score runs and logs: print a table of figures, and write them as JSON and as a page of HTML next to it.

    A DIR gives the figures of its replay. A LOG is mapped and scored: with --weights that were finetuned on it, the
    keyframes they were fitted to never count, and --baselines adds a per-image U-Net and labels carried over by depth,
    both made from those same keyframes. --mesh takes an .npz with vertices, faces and (if there are any) labels.
    `semantic-mapper-research suite` scores weights on rooms that nothing was trained on.

    Example: semantic-mapper eval runs/a runs/b
    Example: semantic-mapper eval kitchen.mcap --weights kitchen.safetensors --baselines
    Example: semantic-mapper eval kitchen.mcap --instances kitchen/instance
    """
    out = results_file(out)
    if baselines and seconds == 0:
        raise typer.BadParameter("the U-Net needs time to learn", param_hint="--seconds")
    must_be_there(*targets or ())
    if not targets:
        raise typer.BadParameter("give folders or logs", param_hint="DIR_OR_LOG")
    output = Output.guarded()
    output.quiet = json
    for target in targets:
        if target.suffix == MAP_SUFFIX:
            raise ConfigError(f"{target}: is a map alone; give the folder with its summary.json, or a log")
    logs = [t for t in targets if is_log(t) or not t.is_dir()]
    folders = [t for t in targets if t not in logs]
    if mesh is not None and not folders:
        raise typer.BadParameter("goes with a DIR that `replay` has written", param_hint="--mesh")
    if instances is not None and not logs:
        raise typer.BadParameter("goes with a LOG", param_hint="--instances")
    path = out or (folders[0] / "eval.json" if folders else targets[0].with_suffix(".eval.json"))
    if out is not None or targets[0].exists():  # no folders for a log that is not there
        prepare_file(path)
    if path.exists():
        note = f"{path}: of an earlier run; will be replaced (--out names another file)"
        stderr_console().print(note, soft_wrap=True)
    found: dict[str, Any] = {"replays": print_results(output, folders), "logs": {}}
    if mesh is not None:
        found["surface"] = {str(f): compare_with_mesh(f, mesh) for f in folders}
        for name, figures in found["surface"].items():
            output.print(f"{name}: {_surface_line(figures)}")
    from semantic_mapper.replay.jobs import evaluate_log

    settings = mapper.load()
    baseline_s = (BASELINE_SECONDS if seconds is None else seconds) if baselines else 0.0
    tables: dict[str, Table] = {}
    for log in logs:
        with frame_progress("score", None) as bar:
            more = {"baseline_s": baseline_s, "instances": instances, "monitor": bar}
            scores = evaluate_log(log, weights, settings, max_frames, **more).plain()
        found["logs"][str(log)] = scores
        tables[str(log)] = score_table(log.name, scores)
        output.print(tables[str(log)])
    write_json(path, found)
    write_eval_report(page := path.with_suffix(".html"), found["replays"], folders, tables, found)
    output.print(f"written to {path} and, for a browser, {page}")
    if json:
        output.json(found)
    return 0


def print_results(output: Output, folders: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Show the tables of result folders side by side, and where the files are.

    Raises:
        ConfigError: see ``read_summary``.
    """
    short = [f.resolve().name for f in folders]
    names = [s if short.count(s) == 1 else str(f) for s, f in zip(short, folders, strict=True)]
    summaries = dict(zip(names, map(read_summary, folders), strict=True))
    if summaries:
        output.print(summary_table(summaries))
    for (name, summary), folder in zip(summaries.items(), folders, strict=True):
        for line in (*(f"{name}: {n}" for n in notes(summary)), *result_lines(folder)):
            output.print(line)
    return summaries


def _surface_line(figures: dict[str, Any]) -> str:
    """One sentence about a map and a mesh."""
    labels = "" if figures["mesh_miou"] is None else f", mIoU at its vertices {figures['mesh_miou'] * 100:.1f} %"
    return (
        f"surface {figures['median_m'] * 1000:.1f} mm (median) from the mesh, "
        f"{figures['complete'] * 100:.1f} % of the mesh within 5 cm of the map, "
        f"{figures['complete_10cm'] * 100:.1f} % within 10 cm{labels}"
    )
