"""``semantic-mapper bench``: measure speed on this machine, as ratios between things measured in one run."""

from __future__ import annotations

import platform
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from nodes.cli_replay import QualityOption
from nodes.console import Output
from nodes.verb import verb


class Part(StrEnum):
    """What to measure."""

    ALL = "all"
    RENDER = "render"
    FUSION = "fusion"
    PIPELINE = "pipeline"
    VIRTUAL = "virtual"


SPEED = (Part.RENDER, Part.FUSION, Part.PIPELINE)


@verb
def bench(
    part: Annotated[Part, typer.Argument(help="What to measure.")] = Part.ALL,
    weights: Annotated[
        Path | None, typer.Option(help="Weights to render with; those in the package without it.")
    ] = None,
    repeats: Annotated[
        int, typer.Option(min=1, help="render: best of so many runs of everything but the reference.")
    ] = 3,
    views: Annotated[
        int | None,
        typer.Option(min=1, help="render: views, of a test room or --log each (1); virtual: at most, a room (8)."),
    ] = None,
    log: Annotated[Path | None, typer.Option(help="render: labelled log to take the views from.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="fusion, pipeline: frames that count.")] = 20,
    rooms: Annotated[int, typer.Option(min=1, max=8, help="virtual: validation rooms to map.")] = 4,
    config: Annotated[
        Path | None, typer.Option(help="pipeline, virtual: TOML file with settings of the mapper.")
    ] = None,
    quality: QualityOption = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures here.")
    ] = None,
) -> None:
    """Measure speed on this machine, as ratios between things measured in one run.

    render: views of test rooms (320x240) or of a log from 8 source views, by the reference renderer and by the
    streaming one at the same weights. fusion: 640x480 frames into 2 cm voxels, our fusion with 20 and 40 classes
    against Open3D's own without any. pipeline: whole steps, 640x480 frames with depth in, the semantic map out. Quote
    ratios, not seconds: seconds depend on the machine and on what else it does. In --json the figures stand under the
    name of the part, and those of a single part at the top, too.

    virtual, which "all" leaves out: what virtual views bring to the maps of validation rooms, and what more rays or
    more frames bring instead; minutes a room.

    Example: semantic-mapper bench --json runs/bench.json
    Example: semantic-mapper bench pipeline --frames 40 --quality fast
    """
    output = Output.guarded()
    from replay.artifacts import versions, write_json

    wanted = SPEED if part is Part.ALL else (part,)
    found: dict[str, Any] = {}
    if Part.RENDER in wanted:
        found["render"] = _render(weights, log, views or 1, repeats, output)
    if Part.FUSION in wanted:
        found["fusion"] = _fusion(frames, output)
    if Part.PIPELINE in wanted:
        from nodes.run_replay import mapper_config
        from replay.bench_map import bench_pipeline

        found["pipeline"] = bench_pipeline(weights, mapper_config(config, None, None, quality), frames)
        output.print(_pipeline_line(found["pipeline"]))
    if Part.VIRTUAL in wanted:
        from nodes.run_replay import mapper_config
        from replay.bench_virtual import bench_virtual

        found["virtual"] = bench_virtual(weights, mapper_config(config, None, None, quality), rooms, views or 8)
        output.print(_virtual_table(found["virtual"]))
    if part is not Part.ALL:
        found |= found[part.value]
    found["machine"] = {"cpu": cpu_name(), "versions": versions()}
    output.print(f"on {found['machine']['cpu']}")
    if json_file is not None:
        write_json(json_file, found)
        output.print(f"written to {json_file}")


def _render(weights: Path | None, log: Path | None, views: int, repeats: int, output: Output) -> dict[str, Any]:
    from replay.bench import bench_render, log_scenes, room_scenes
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint

    scenes = room_scenes(views) if log is None else log_scenes(log, views)
    render = bench_render(load_checkpoint(weights or default_checkpoint_path()), scenes, repeats)
    output.print(_render_table(render))
    output.print(
        f"streaming (balanced) is {render['speedup']} times faster than the reference, with all rays and 8 samples "
        f"{render['speedup_all_rays']} times"
    )
    return render


def _fusion(frames: int, output: Output) -> dict[str, Any]:
    from replay.bench_map import bench_fusion

    fusion = bench_fusion(frames)
    output.print(_fusion_line(fusion))
    return fusion


def cpu_name() -> str:
    """Model name of the processor."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()


def _render_table(render: dict[str, Any]) -> Table:
    table = Table(title=f"rendering {render['view']}, {render['views']} views")
    for column in ("renderer", "pixels/s", "view, wall s", "view, CPU s", "CPU s per 2048 pixels", "mIoU"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    for name, row in render["renderers"].items():
        values = (row["pixels_per_s"], row["view_wall_s"], row["view_cpu_s"], row["cpu_s_per_2048_pixels"])
        table.add_row(name, *(f"{v:,}" for v in values), f"{row['miou'] * 100:.1f} %")
    return table


def _fusion_line(fusion: dict[str, Any]) -> str:
    return (
        f"fusion of 640x480 into {fusion['voxel_size_m'] * 100:g} cm voxels: Open3D {fusion['open3d_ms']} ms a frame "
        f"without classes, ours {fusion['ms_20']} ms with 20 ({fusion['ratio_20']} times) and {fusion['ms_40']} ms "
        f"with 40 ({fusion['ratio_40']} times)"
    )


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


def _pipeline_line(pipeline: dict[str, Any]) -> str:
    stages = ", ".join(f"{name} {value}" for name, value in pipeline["stages_ms"].items())
    return (
        f"pipeline at {pipeline['size']}: {pipeline['hz']} frames/s, a step {pipeline['p50_ms']} ms (p50), "
        f"{pipeline['p95_ms']} ms (p95); mIoU {pipeline['miou'] * 100:.1f} %; stages in ms: {stages}"
    )
