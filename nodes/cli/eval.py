"""``semantic-mapper eval``: figures of replays side by side, or of a log by several methods."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semantic_mapper.nodes.cli.console import Output
from semantic_mapper.nodes.cli.replay import ConfigOption, MaxFramesOption
from semantic_mapper.nodes.cli.verb import JsonOption, must_be_there, results_file, verb

if TYPE_CHECKING:
    from rich.table import Table

    from semantic_mapper.config import MapperConfig

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
SeedOption = Annotated[int | None, typer.Option(min=0, help="Of everything that is drawn at random.  [default: 0]")]


@verb
def evaluate(
    targets: TargetsArgument = None,
    weights: WeightsOption = None,
    baselines: BaselinesOption = False,
    seconds: SecondsOption = None,
    mesh: MeshOption = None,
    instances: InstancesOption = None,
    max_frames: MaxFramesOption = 0,
    config: ConfigOption = None,
    seed: SeedOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> int:
    """Score runs and logs: print a table of figures, and write them as JSON and as a page of HTML beside it.

    A DIR gives the figures of its replay. A LOG is mapped and scored: with --weights that were finetuned on it, the
    keyframes they were fitted to never count, and --baselines adds a per-image U-Net and labels carried over by depth,
    both made from those same keyframes. --mesh takes an .npz with vertices, faces and (if there are any) labels.
    `semantic-mapper benchmark` scores weights on rooms that nothing was trained on.

    Example: semantic-mapper eval runs/a runs/b
    Example: semantic-mapper eval kitchen.mcap --weights kitchen.safetensors --baselines
    Example: semantic-mapper eval kitchen.mcap --instances kitchen/instance
    """
    out, print_json = results_file(out), json
    if baselines and seconds == 0:
        raise typer.BadParameter("the U-Net needs time to learn", param_hint="--seconds")
    must_be_there(*targets or ())
    baseline_s = BASELINE_SECONDS if seconds is None else seconds
    from semantic_mapper.nodes.cli.run_replay import mapper_config

    mapper = mapper_config(config, None, seed or 0)
    options = weights, baselines, baseline_s, max_frames, mapper, seed or 0, instances
    return _evaluate_targets(targets or [], options, mesh, out, print_json=print_json)


def _evaluate_targets(
    targets: list[Path],
    options: tuple[Path | None, bool, float, int, MapperConfig, int, Path | None],
    mesh: Path | None,
    json_file: Path | None,
    *,
    print_json: bool,
) -> int:
    """Figures of folders and logs; ``options`` are those of ``scoring.ScoreRequest`` after the log."""
    if not targets:
        raise typer.BadParameter("give folders or logs", param_hint="DIR_OR_LOG")
    output = Output.guarded()
    output.quiet = print_json
    from semantic_mapper.errors import ConfigError
    from semantic_mapper.files import write_json
    from semantic_mapper.nodes.cli.outputs import prepare_file, say_replaced
    from semantic_mapper.nodes.cli.report import write_eval_report
    from semantic_mapper.nodes.cli.results import print_results
    from semantic_mapper.nodes.cli.saved_maps import MAP_SUFFIX, is_log

    for target in targets:
        if target.suffix == MAP_SUFFIX:
            raise ConfigError(f"{target}: is a map alone; give the folder with its summary.json, or a log")
    logs = [t for t in targets if is_log(t) or not t.is_dir()]
    folders = [t for t in targets if t not in logs]
    if mesh is not None and not folders:
        raise typer.BadParameter("goes with a DIR that `replay` has written", param_hint="--mesh")
    if options[-1] is not None and not logs:
        raise typer.BadParameter("goes with a LOG", param_hint="--instances")
    path = json_file or (folders[0] / "eval.json" if folders else targets[0].with_suffix(".eval.json"))
    if json_file is not None or targets[0].exists():  # no folders for a log that is not there
        prepare_file(path)
    say_replaced(path)
    found: dict[str, Any] = {"replays": {}, "logs": {}}
    tables: dict[str, Table] = {}
    if folders:
        found["replays"] = print_results(output, folders)
    if mesh is not None:
        from semantic_mapper.replay.evaluate.mesh_surface import compare_with_mesh

        found["surface"] = {str(f): compare_with_mesh(f, mesh) for f in folders}
        for name, figures in found["surface"].items():
            output.print(f"{name}: {surface_line(figures)}")
    for log in logs:
        from semantic_mapper.nodes.cli.scoring import ScoreRequest, score_log, score_table

        found["logs"][str(log)] = scores = score_log(ScoreRequest(log, *options))
        tables[str(log)] = score_table(log.name, scores)
        output.print(tables[str(log)])
        for note in scores["notes"]:
            output.print(note)
    write_json(path, found)
    write_eval_report(page := path.with_suffix(".html"), found["replays"], folders, tables, found)
    output.print(f"written to {path} and, for a browser, {page}")
    if print_json:
        output.json(found)
    return 0


def surface_line(figures: dict[str, Any]) -> str:
    """One sentence about a map and a mesh."""
    labels = "" if figures["mesh_miou"] is None else f", mIoU at its vertices {figures['mesh_miou'] * 100:.1f} %"
    return (
        f"surface {figures['median_m'] * 1000:.1f} mm (median) from the mesh, "
        f"{figures['complete'] * 100:.1f} % of the mesh within 5 cm of the map, "
        f"{figures['complete_10cm'] * 100:.1f} % within 10 cm{labels}"
    )
