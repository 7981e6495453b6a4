"""``semantic-mapper bench``: measure speed on this machine, as ratios between things measured in one run."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from nodes.console import Output
from nodes.verb import verb


@verb
def bench(
    weights: Annotated[
        Path | None, typer.Option(help="Weights to render with; those in the package without it.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Best of so many runs of everything but the reference.")] = 3,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures here.")
    ] = None,
) -> None:
    """Time the reference renderer against the streaming one, at the same weights and in one run.

    Both render a 320x240 view of a test room from 8 source views. Quote ratios, not seconds: seconds depend on the
    machine and on what else it does.

    Example: semantic-mapper bench --json runs/bench.json
    """
    output = Output.guarded()
    from replay.artifacts import versions, write_json
    from replay.bench import bench_render
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint

    render = bench_render(load_checkpoint(weights or default_checkpoint_path()), repeats=repeats)
    machine = {"cpu": cpu_name(), "threads": render["threads"], "versions": versions()}
    output.print(_table(render))
    output.print(
        f"streaming is {render['speedup']} times faster than the reference, "
        f"{render['speedup_at_equal_samples']} times at equal samples ({machine['cpu']}, "
        f"{machine['threads']} threads)"
    )
    if json_file is not None:
        write_json(json_file, {"render": render, "machine": machine})
        output.print(f"written to {json_file}")


def cpu_name() -> str:
    """Model name of the processor."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()


def _table(render: dict[str, Any]) -> Table:
    table = Table(title=f"rendering {render['view']}")
    for column in ("renderer", "rays/s", "view, wall s", "view, CPU s", "CPU s per 2048 rays"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    for name, row in render["renderers"].items():
        values = (row["rays_per_s"], row["view_wall_s"], row["view_cpu_s"], row["cpu_s_per_2048_rays"])
        table.add_row(name, *(f"{v:,}" for v in values))
    return table
