"""``semantic-mapper eval``: figures of replays side by side, or of a log by several methods."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nodes.cli_replay import ConfigOption, MaxFramesOption, WeightsOption
from nodes.console import Output
from nodes.verb import verb


@verb
def evaluate(
    targets: Annotated[
        list[Path], typer.Argument(metavar="DIR_OR_LOG...", help="Folders that `replay` has written, and logs.")
    ],
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json",
            metavar="FILE",
            help="Where to write; else eval.json in the first DIR, or LOG.eval.json beside the first log.",
        ),
    ] = None,
    weights: WeightsOption = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="LOG: also fit the baselines to the keyframes of the weights.")
    ] = False,
    seconds: Annotated[float, typer.Option(min=1, help="Training time of the U-Net baseline.")] = 300.0,
    mesh: Annotated[
        Path | None, typer.Option(metavar="NPZ", help="DIR: also compare its map with this reference mesh.")
    ] = None,
    max_frames: MaxFramesOption = 0,
    config: ConfigOption = None,
    seed: Annotated[int, typer.Option(help="Of everything that is drawn at random.")] = 0,
) -> None:
    """Print a table of figures and write them as JSON.

    A DIR gives the figures of its replay. A LOG is mapped and scored: with --weights that were finetuned on it, the
    keyframes they were fitted to never count, and --baselines adds a per-image U-Net and labels carried over by depth,
    both made from those same keyframes.

    --mesh takes an .npz with vertices, faces and (if there are any) labels of the vertices, in the frame of the log.

    Example: semantic-mapper eval runs/a runs/b
    Example: semantic-mapper eval kitchen.mcap --weights kitchen.safetensors --baselines
    """
    output = Output.guarded()
    from nodes.results import print_results
    from replay.artifacts import write_json

    folders = [t for t in targets if t.is_dir()]
    found: dict[str, Any] = {"replays": {}, "logs": {}}
    if folders:
        found["replays"] = print_results(output, folders)
    if mesh is not None:
        from replay.surface import compare_with_mesh

        found["surface"] = {str(f): compare_with_mesh(f, mesh) for f in folders}
        for name, figures in found["surface"].items():
            output.print(f"{name}: {surface_line(figures)}")
    for log in (t for t in targets if not t.is_dir()):
        from nodes.scoring import ScoreRequest, score_log, score_table

        request = ScoreRequest(log, weights, baselines, seconds, max_frames, config, seed)
        found["logs"][str(log)] = scores = score_log(request)
        output.print(score_table(log.name, scores))
    path = json_file or (folders[0] / "eval.json" if folders else targets[0].with_suffix(".eval.json"))
    write_json(path, found)
    output.print(f"written to {path}")


def surface_line(figures: dict[str, Any]) -> str:
    """One sentence about a map and a mesh."""
    labels = "" if figures["mesh_miou"] is None else f", mIoU at its vertices {figures['mesh_miou'] * 100:.1f} %"
    return (
        f"surface {figures['median_m'] * 1000:.1f} mm (median) from the mesh, "
        f"{figures['complete'] * 100:.1f} % of the mesh within 5 cm of the map{labels}"
    )
