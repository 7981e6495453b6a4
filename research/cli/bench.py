"""``semantic-mapper-research bench``: rendering against the reference, and a long walk through a building."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.table import Table

from research.bench.plots import draw_walk
from research.bench.render import bench_render, log_scenes, room_scenes
from research.bench.walk import SLOPE_MINUTES, WalkPlan, bench_walk
from semantic_mapper.config import MapperConfig, load_config
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.files import write_json
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.plots import write_picture

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Measure speed, as ratios within one run.")
WeightsOption = Annotated[Path | None, typer.Option(help="Weights; without it those that ship.")]
OutOption = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Also write the figures here, as JSON.")]


@app.command()
@verb
def render(
    weights: WeightsOption = None,
    repeats: Annotated[int, typer.Option(min=1, help="Best of this many runs of all but the reference.")] = 3,
    views: Annotated[int, typer.Option(min=1, help="Views, of a test room or of --log each.")] = 1,
    log: Annotated[Path | None, typer.Option(help="Labelled log to take the views from.")] = None,
    out: OutOption = None,
) -> None:
    """Render views from 8 source views, by the reference renderer and by the streaming one, at the same weights."""
    output = Output.guarded()
    scenes = room_scenes(views) if log is None else log_scenes(log, views)
    found = bench_render(load_checkpoint(weights or default_checkpoint_path()), scenes, repeats)
    output.print(_render_table(found))
    output.print(
        f"streaming (balanced) is {found['speedup']} times faster than the reference, with all rays and 8 samples "
        f"{found['speedup_all_rays']} times"
    )
    if out is not None:
        write_json(out, found)


@app.command("map")
@verb
def map_(
    weights: WeightsOption = None,
    config: Annotated[Path | None, typer.Option(help="Settings of the mapper.")] = None,
    rooms: Annotated[int, typer.Option(min=1, help="Rooms of the building.")] = 30,
    loops: Annotated[int, typer.Option(min=0, help="Rooms, from the first on, visited again at the end.")] = 6,
    minutes: Annotated[float, typer.Option(min=0.01, help="Length of the walk, by the frames' stamps.")] = 60.0,
    hz: Annotated[float, typer.Option(min=0.1, max=60, help="Frames a second of the walk.")] = 2.0,
    width: Annotated[int, typer.Option(min=64, max=1920, help="Of the images, 4 : 3.")] = 320,
    memory_mb: Annotated[int | None, typer.Option(min=0, help="voxel_map.memory_mb of the mapper.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw time and memory by minute.")] = None,
    out: OutOption = None,
) -> None:
    """Walk through a building and back: time and memory by minute, and whether rooms are as they were left."""
    output = Output.guarded()
    plan = WalkPlan(rooms, loops, minutes, hz, width)
    settings = load_config(config, MapperConfig) if config else MapperConfig()
    if memory_mb is not None:
        voxel_map = msgspec.structs.replace(settings.voxel_map, memory_mb=memory_mb)
        settings = msgspec.structs.replace(settings, voxel_map=voxel_map)
    with frame_progress("walk", plan.frames) as bar:
        bar.start(plan.frames)
        found = bench_walk(weights, settings, plan, bar.set)
    if plot is not None:
        write_picture(plot, draw_walk(found))
    output.print(
        f"{found['rooms']} rooms, {found['minutes']:g} minutes at {found['hz']:g} Hz: a step {found['step_p50_ms']} ms "
        f"(p50), {found['step_p95_ms']} ms (p95), {found['cpu_p50_ms']} ms of processor time; {_slopes(found)}"
    )
    output.print(
        f"{found['blocks']} blocks, at most {found['blocks_in_memory_at_most']} in memory; {found['store_mb']} MB on "
        f"disk; {found['rss_last_minute_mb']} MB resident, at most {found['rss_max_mb']}"
    )
    output.print(f"{found['returns_unchanged']} of {found['returns']} rooms unchanged when the walk came back to them")
    if out is not None:
        write_json(out, found)


def _slopes(found: dict[str, Any]) -> str:
    step, cpu = found["step_slope_percent_a_minute"], found["cpu_slope_percent_a_minute"]
    if step is None:
        return f"too short for a slope (less than {SLOPE_MINUTES} minutes)"
    return f"their slopes {step:+g} and {cpu:+g} % a minute"


def _render_table(found: dict[str, Any]) -> Table:
    table = Table(title=f"rendering {found['view']}, {found['views']} views")
    for column in ("renderer", "pixels/s", "view, wall s", "view, CPU s", "CPU s per 2048 pixels", "mIoU"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    for name, row in found["renderers"].items():
        values = (row["pixels_per_s"], row["view_wall_s"], row["view_cpu_s"], row["cpu_s_per_2048_pixels"])
        table.add_row(name, *(f"{v:,}" for v in values), f"{row['miou'] * 100:.1f} %")
    return table
