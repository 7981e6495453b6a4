"""``semantic-mapper eval``: figures of replays side by side, of a log by several methods, or of a benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semantic_mapper.nodes.cli import suite_options as suites
from semantic_mapper.nodes.cli.console import Output
from semantic_mapper.nodes.cli.replay import MaxFramesOption
from semantic_mapper.nodes.cli.verb import verb

if TYPE_CHECKING:
    from rich.table import Table

BASELINE_SECONDS = 300.0

TargetsArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="DIR_OR_LOG...", help="Folders that `replay` has written; logs, or folders with their parts."
    ),
]
JsonOption = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Where to write; else eval.json in the first DIR, LOG.eval.json by the first log, or runs/rooms-*.json.",
    ),
]
WeightsOption = Annotated[
    list[Path] | None,
    typer.Option("--weights", help="Weights file; the one in the package without it. Suite: give several to compare."),
]
BaselinesOption = Annotated[
    bool, typer.Option("--baselines", help="LOG: also fit the baselines to the keyframes of the weights.")
]
MeshOption = Annotated[
    Path | None, typer.Option(metavar="NPZ", help="DIR: also compare its map with this reference mesh.")
]
SeedOption = Annotated[int | None, typer.Option(min=0, help="Of everything that is drawn at random.  [default: 0]")]


@verb
def evaluate(
    targets: TargetsArgument = None,
    json_file: JsonOption = None,
    weights: WeightsOption = None,
    baselines: BaselinesOption = False,
    seconds: suites.SecondsOption = None,
    mesh: MeshOption = None,
    max_frames: MaxFramesOption = 0,
    config: suites.EvalConfigOption = None,
    seed: SeedOption = None,
    suite: suites.SuiteOption = None,
    split: suites.SplitOption = None,
    rooms: suites.RoomsOption = None,
    protocol: suites.ProtocolOption = None,
    kind: suites.KindOption = None,
    views: suites.ViewsOption = None,
    baseline: suites.BaselineOption = None,
    depth: suites.DepthOption = None,
    tier: suites.TierOption = None,
    keyframes: suites.KeyframesOption = None,
    steps: suites.StepsOption = None,
    maps: suites.MapOption = False,
) -> int:
    """Print a table of figures and write them as JSON, and as a page of HTML beside it.

    A DIR gives the figures of its replay. A LOG is mapped and scored: with --weights that were finetuned on it, the
    keyframes they were fitted to never count, and --baselines adds a per-image U-Net and labels carried over by depth,
    both made from those same keyframes. --mesh takes an .npz with vertices, faces and (if there are any) labels.

    --suite rooms renders query views of rooms that nothing was trained on, one column a weights file, and draws a
    contact sheet. A run that was ended goes on where it was; docs/benchmarks.md says what each figure means.

    Example: semantic-mapper eval runs/a runs/b
    Example: semantic-mapper eval kitchen.mcap --weights kitchen.safetensors --baselines
    Example: semantic-mapper eval --suite rooms --protocol scratch --kind semantic_nerf --rooms 3 --seconds 600
    Example: semantic-mapper eval --suite rooms --weights a.safetensors --weights b.safetensors --json runs/ab.json
    """
    given = {"split": split, "rooms": rooms, "protocol": protocol, "views": views, "baseline": baseline, "depth": depth}
    given |= {"keyframes": keyframes, "steps": steps}
    if suite is None:
        if maps or tier or kind or any(value is not None for value in given.values()):
            raise typer.BadParameter("is what this option needs", param_hint="--suite rooms")
        if baselines and seconds == 0:
            raise typer.BadParameter("the U-Net needs time to learn", param_hint="--seconds")
        baseline_s = BASELINE_SECONDS if seconds is None else seconds
        options = _single(weights), baselines, baseline_s, max_frames, config, seed or 0
        return _evaluate_targets(targets or [], options, mesh, json_file)
    if targets or baselines or mesh or max_frames:
        raise typer.BadParameter("takes no DIR_OR_LOG, --baselines, --mesh or --max-frames", param_hint="--suite")
    if maps and protocol in ("finetune", "scratch"):
        raise typer.BadParameter("goes with --protocol generalize only", param_hint="--map")
    from semantic_mapper.nodes.cli.suite import run_suite_verb

    settings = suites.suite_config(config, tier, {**given, "seconds": seconds, "seed": seed})
    if settings.protocol != "generalize" and baseline is not None:
        raise typer.BadParameter("goes with --protocol generalize: keyframes are all there is", param_hint="--baseline")
    if settings.protocol == "generalize" and not (steps is None and seconds is None and keyframes is None):
        hint = "--steps, --seconds, --keyframes"
        raise typer.BadParameter("go with --protocol finetune and scratch", param_hint=hint)
    return run_suite_verb(settings, weights or [], kind or [], maps, json_file)


def _single(weights: list[Path] | None) -> Path | None:
    if weights is not None and len(weights) > 1:
        raise typer.BadParameter("several are compared with --suite only", param_hint="--weights")
    return weights[0] if weights else None


def _evaluate_targets(
    targets: list[Path],
    options: tuple[Path | None, bool, float, int, Path | None, int],
    mesh: Path | None,
    json_file: Path | None,
) -> int:
    """Figures of folders and logs; ``options`` are those of ``scoring.ScoreRequest`` after the log."""
    if not targets:
        raise typer.BadParameter("give folders or logs, or --suite", param_hint="DIR_OR_LOG")
    output = Output.guarded()
    from semantic_mapper.errors import ConfigError
    from semantic_mapper.nodes.cli.report import write_eval_report
    from semantic_mapper.nodes.cli.results import print_results
    from semantic_mapper.nodes.cli.saved_maps import MAP_SUFFIX, is_log
    from semantic_mapper.replay.artifacts import write_json

    for target in targets:
        if target.suffix == MAP_SUFFIX:
            raise ConfigError(f"{target}: is a map alone; give the folder with its summary.json, or a log")
    logs = [t for t in targets if is_log(t) or not t.is_dir()]
    folders = [t for t in targets if t not in logs]
    if mesh is not None and not folders:
        raise typer.BadParameter("goes with a DIR that `replay` has written", param_hint="--mesh")
    found: dict[str, Any] = {"replays": {}, "logs": {}}
    tables: dict[str, Table] = {}
    if folders:
        found["replays"] = print_results(output, folders)
    if mesh is not None:
        from semantic_mapper.replay.compare.surface import compare_with_mesh

        found["surface"] = {str(f): compare_with_mesh(f, mesh) for f in folders}
        for name, figures in found["surface"].items():
            output.print(f"{name}: {surface_line(figures)}")
    for log in logs:
        from semantic_mapper.nodes.cli.scoring import ScoreRequest, score_log, score_table

        found["logs"][str(log)] = scores = score_log(ScoreRequest(log, *options))
        tables[str(log)] = score_table(log.name, scores)
        output.print(tables[str(log)])
    path = json_file or (folders[0] / "eval.json" if folders else targets[0].with_suffix(".eval.json"))
    write_json(path, found)
    write_eval_report(page := path.with_suffix(".html"), found["replays"], folders, tables, found)
    output.print(f"written to {path} and, for a browser, {page}")
    return 0


def surface_line(figures: dict[str, Any]) -> str:
    """One sentence about a map and a mesh."""
    labels = "" if figures["mesh_miou"] is None else f", mIoU at its vertices {figures['mesh_miou'] * 100:.1f} %"
    return (
        f"surface {figures['median_m'] * 1000:.1f} mm (median) from the mesh, "
        f"{figures['complete'] * 100:.1f} % of the mesh within 5 cm of the map{labels}"
    )
