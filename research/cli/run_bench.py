"""The measurements behind ``semantic-mapper bench``: each gives plain data, and lines for people to read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from rich.table import Table

from research.bench.depthless import bench_depthless
from research.bench.evidence import bench_evidence
from research.bench.fusion import bench_fusion, bench_pipeline, bench_qualities
from research.bench.growth import AXES, bench_growth
from research.bench.plots import draw_growth, draw_pipeline, draw_walk
from research.bench.render import bench_render, log_scenes, room_scenes
from research.bench.virtual import bench_virtual
from research.bench.walk import SLOPE_MINUTES, WalkPlan, bench_walk
from research.cli.bench_queries import bench_queries
from semantic_mapper.config import MapperConfig
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint
from semantic_mapper.nodes.cli.console import Output, frame_progress
from semantic_mapper.plots import write_picture


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """Best of ``repeats`` over this many views, of a labelled ``log`` or (None) of test rooms."""

    repeats: int
    views: int
    log: Path | None


@dataclass(frozen=True, slots=True)
class QueriesRequest:
    """This many questions a second, while images of this width are mapped."""

    rate_hz: float
    width: int


@dataclass(frozen=True, slots=True)
class BenchRequest:
    """What the options of ``bench`` ask for.

    Args:
        weights: None = those that ship with the package.
        config: Of the mapper.
        render: Of the rendering.
        frames: That count.
        plan: Of the long walk.
        memory_mb: In the long walk, in place of what ``config`` says; None = as it says.
        plot: Where to draw the long walk, the growth, or the stages of a step; None = nowhere.
        virtual: Rooms, and virtual views at most in each.
        queries: Of the questions.
    """

    weights: Path | None
    config: MapperConfig
    render: RenderRequest
    frames: int
    plan: WalkPlan
    memory_mb: int | None
    plot: Path | None
    virtual: tuple[int, int]
    queries: QueriesRequest


def run_render(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure rendering."""
    asked = request.render
    scenes = room_scenes(asked.views) if asked.log is None else log_scenes(asked.log, asked.views)
    found = bench_render(load_checkpoint(request.weights or default_checkpoint_path()), scenes, asked.repeats)
    output.print(_render_table(found))
    output.print(
        f"streaming (balanced) is {found['speedup']} times faster than the reference, with all rays and 8 samples "
        f"{found['speedup_all_rays']} times"
    )
    return found


def run_fusion(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure fusion against Open3D's."""
    found = bench_fusion(request.frames)
    output.print(
        f"fusion of 640x480 into {found['voxel_size_m'] * 100:g} cm voxels: Open3D {found['open3d_ms']} ms a frame "
        f"without classes, ours {found['ms_20']} ms with 20 ({found['ratio_20']} times) and {found['ms_40']} ms "
        f"with 40 ({found['ratio_40']} times); with evidence in int16 {found['ratio_20_int16']} and "
        f"{found['ratio_40_int16']} times"
    )
    return found


def run_pipeline(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure whole steps."""
    found = bench_pipeline(request.weights, request.config, request.frames)
    stages = ", ".join(f"{name} {value}" for name, value in found["stages_ms"].items())
    output.print(
        f"pipeline at {found['size']}, {found['depth']} depth: {found['hz']} frames/s, a step {found['p50_ms']} ms "
        f"(p50), {found['p95_ms']} ms (p95); mIoU {found['miou'] * 100:.1f} %; stages in ms: {stages}"
    )
    if request.plot is not None:
        qualities = bench_qualities(request.weights, request.config, request.frames, found)
        write_picture(request.plot, draw_pipeline(qualities))
        found = {**found, "qualities": qualities}
    return found


def run_map(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure the long walk."""
    config = request.config
    if request.memory_mb is not None:
        voxel_map = msgspec.structs.replace(config.voxel_map, memory_mb=request.memory_mb)
        config = msgspec.structs.replace(config, voxel_map=voxel_map)
    with frame_progress("walk", request.plan.frames) as bar:
        bar.start(request.plan.frames)
        found = bench_walk(request.weights, config, request.plan, bar.set)
    if request.plot is not None:
        write_picture(request.plot, draw_walk(found))
    output.print(
        f"{found['rooms']} rooms, {found['minutes']:g} minutes at {found['hz']:g} Hz: a step {found['step_p50_ms']} ms "
        f"(p50), {found['step_p95_ms']} ms (p95), {found['cpu_p50_ms']} ms of processor time; {_slopes(found)}"
    )
    growth, fraction = found["rss_growth_mb"], found["rss_growth_percent_of_limit"]
    output.print(
        f"{found['blocks']} blocks, at most {found['blocks_in_memory_at_most']} in memory; {found['store_mb']} MB on "
        f"disk; {found['rss_last_minute_mb']} MB resident, at most {found['rss_max_mb']}"
        + ("" if growth is None else f", {growth:+g} MB since minute 5")
        + ("" if fraction is None else f" ({fraction:+g} % of the limit)")
    )
    limit = f"it has {found['memory_mb']} MB" if found["memory_mb"] else "it has no limit"
    output.print(
        f"one frame touches up to {found['frame_mb_at_most']} MB of the map; voxel_map.memory_mb should be "
        f"{found['memory_advised_mb']} or more ({limit})"
    )
    output.print(f"{found['returns_unchanged']} of {found['returns']} rooms unchanged when the walk came back to them")
    return found


def _slopes(found: dict[str, Any]) -> str:
    step, cpu = found["step_slope_percent_a_minute"], found["cpu_slope_percent_a_minute"]
    if step is None:
        return f"too short for a slope (less than {SLOPE_MINUTES} minutes)"
    first, last = found["step_p50_first_ten_minutes_ms"], found["step_p50_last_ten_minutes_ms"]
    compared = "" if first is None else f"; {first} ms (p50) in minutes 5 to 15, {last} ms in the last ten"
    return f"their slopes {step:+g} and {cpu:+g} % a minute{compared}"


def run_growth(request: BenchRequest, output: Output) -> list[dict[str, Any]]:
    """Measure steps as one setting grows."""
    with frame_progress("growth", sum(map(len, AXES.values())), "runs") as bar:
        found = bench_growth(request.weights, request.config, request.frames, request.plan.width, bar.set)
    if request.plot is not None:
        size = f"{request.plan.width}x{request.plan.width * 3 // 4}"
        title = f"a step at {size} as one setting grows, the others as they are"
        write_picture(request.plot, draw_growth(found, title))
    table = Table(title=f"ms of a step as one setting grows, width {request.plan.width}")
    for column in found[0]:
        table.add_column(column.removesuffix("_ms"), justify="left" if column == "axis" else "right")
    for row in found:
        table.add_row(*(f"{v:,}" if isinstance(v, int) else f"{v}" for v in row.values()))
    output.print(table)
    return found


def run_virtual(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure what virtual views bring."""
    found = bench_virtual(request.weights, request.config, *request.virtual)
    output.print(_virtual_table(found))
    return found


def run_queries(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure questions to a map that is being built."""
    asked = request.queries
    found = bench_queries(request.weights, request.config, request.frames, asked.rate_hz, asked.width)
    table = Table(title=f"questions while {found['size']} frames are mapped, {found['asked_hz']:g} a second")
    for column in ("question", "asked", "p50, ms", "p95, ms"):
        table.add_column(column, justify="left" if column == "question" else "right")
    for kind, count in found["asked"].items():
        table.add_row(kind, str(count), f"{found['p50_ms'][kind]:g}", f"{found['p95_ms'][kind]:g}")
    output.print(table)
    output.print(
        f"a step {found['asked_step_p50_ms']} ms (p50), {found['asked_step_p95_ms']} ms (p95), with nobody asking "
        f"{found['quiet_step_p50_ms']} and {found['quiet_step_p95_ms']} ms ({found['step_ratio']} and "
        f"{found['step_p95_ratio']} times; processor time {found['cpu_ratio']} times); of it, handing changes over "
        f"{found['follow_p95_ms']} ms (p95); waiting for an answer at most {found['longest_wait_ms']:g} ms"
    )
    return found


def run_evidence(request: BenchRequest, output: Output) -> dict[str, Any]:
    """Measure what each way to keep class evidence costs."""
    found = bench_evidence(request.weights, request.config, request.virtual[0])
    for kind, row in found["kinds"].items():
        output.print(
            f"{kind}: {row['block_kib']} KiB a block; map mIoU {row['miou'] * 100:.2f} %, accuracy "
            f"{row['accuracy'] * 100:.2f} %, ECE {row['ece'] * 100:.2f} %"
        )
    return found


def run_depthless(request: BenchRequest, output: Output) -> list[dict[str, Any]]:
    """Measure the surface of maps from frames without depth."""
    found = bench_depthless(request.weights, request.config, request.frames)
    for row in found:
        output.print(", ".join(f"{name} {value}" for name, value in row.items()))
    return found


def _render_table(render: dict[str, Any]) -> Table:
    table = Table(title=f"rendering {render['view']}, {render['views']} views")
    for column in ("renderer", "pixels/s", "view, wall s", "view, CPU s", "CPU s per 2048 pixels", "mIoU"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    for name, row in render["renderers"].items():
        values = (row["pixels_per_s"], row["view_wall_s"], row["view_cpu_s"], row["cpu_s_per_2048_pixels"])
        table.add_row(name, *(f"{v:,}" for v in values), f"{row['miou'] * 100:.1f} %")
    return table


def _virtual_table(virtual: dict[str, Any]) -> Table:
    table = Table(title=f"maps of {virtual['rooms']} validation rooms, {virtual['frames']} frames each")
    shares = ("map mIoU", "accuracy", "mIoU where plain votes", "voted", "ECE")
    for column in ("frames", "variant", *shares, "CPU s", "views"):
        table.add_column(column, justify="left" if column in ("frames", "variant") else "right")
    for name, variants in virtual["coverages"].items():
        for variant, row in variants.items():
            values = (row[key] for key in ("miou", "accuracy", "miou_where_plain_votes", "voted", "ece"))
            rest = (f"{row['cpu_s']:g}", str(row["views"]))
            table.add_row(name, variant, *(f"{value * 100:.1f} %" for value in values), *rest)
    return table


MEASUREMENTS: dict[str, Callable[[BenchRequest, Output], Any]] = {
    "render": run_render,
    "fusion": run_fusion,
    "pipeline": run_pipeline,
    "growth": run_growth,
    "map": run_map,
    "virtual": run_virtual,
    "queries": run_queries,
    "evidence": run_evidence,
    "depthless": run_depthless,
}
