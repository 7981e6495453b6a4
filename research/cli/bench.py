"""``semantic-mapper bench``: measure speed on this machine, as ratios between things measured in one run."""

from __future__ import annotations

import platform
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from semantic_mapper.nodes.cli.console import Output
from semantic_mapper.nodes.cli.replay import ConfigOption, QualityOption, VoxelSizeOption, WeightsOption
from semantic_mapper.nodes.cli.verb import JsonOption, results_file, verb


class Part(StrEnum):
    """What to measure."""

    ALL = "all"
    RENDER = "render"
    FUSION = "fusion"
    PIPELINE = "pipeline"
    GROWTH = "growth"
    MAP = "map"
    VIRTUAL = "virtual"
    QUERIES = "queries"
    EVIDENCE = "evidence"
    DEPTHLESS = "depthless"


QUICK = (Part.RENDER, Part.FUSION, Part.PIPELINE)  # what "all" stands for
RepeatsOption = Annotated[int, typer.Option(min=1, help="render: best of this many runs of all but the reference.")]
FramesOption = Annotated[
    int, typer.Option(min=1, help="fusion, pipeline, growth, queries, depthless: frames that count.")
]
ViewsOption = Annotated[
    int | None,
    typer.Option(min=1, help="render: views, of a test room or --log each (1); virtual: at most, a room (8)."),
]
LogOption = Annotated[Path | None, typer.Option(help="render: labelled log to take the views from.")]
RoomsOption = Annotated[
    int | None,
    typer.Option(min=1, help="map: rooms of the building (30); virtual, evidence: validation rooms to map (4)."),
]
LoopsOption = Annotated[int, typer.Option(min=0, help="map: rooms, from the first on, visited again at the end.")]
MinutesOption = Annotated[float, typer.Option(min=0.01, help="map: length of the walk, by the frames' stamps.")]
HzOption = Annotated[float, typer.Option(min=0.1, max=60, help="map: frames a second of the walk.")]
WidthOption = Annotated[
    int | None,
    typer.Option(min=64, max=1920, help="Of the images, 4 : 3; growth, map (320), queries (640)."),
]
RateOption = Annotated[float, typer.Option(min=0.1, max=1000, help="queries: questions a second, of all kinds.")]
MemoryOption = Annotated[
    int | None, typer.Option("--memory-mb", min=0, help="map: voxel_map.memory_mb; without it as --config says.")
]
PlotOption = Annotated[
    Path | None,
    typer.Option(
        metavar="PNG",
        help="map: also draw time and memory by minute; growth: time by each setting; "
        "pipeline: the stages of a step, of qualities fast and balanced (measures both).",
    ),
]
DepthOption = Annotated[
    Literal["sensor", "computed"] | None,
    typer.Option(help="pipeline: the frames' depth is measured, or computed from their pictures.  [default: sensor]"),
]
OutOption = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Also write the figures here, as JSON.")]


@verb
def bench(
    part: Annotated[Part, typer.Argument(help="What to measure; all: the first three.")] = Part.ALL,
    weights: WeightsOption = None,
    repeats: RepeatsOption = 3,
    views: ViewsOption = None,
    log: LogOption = None,
    frames: FramesOption = 20,
    config: ConfigOption = None,
    quality: QualityOption = None,
    voxel_size: VoxelSizeOption = None,
    depth: DepthOption = None,
    rooms: RoomsOption = None,
    loops: LoopsOption = 6,
    minutes: MinutesOption = 60.0,
    hz: HzOption = 2.0,
    width: WidthOption = None,
    rate: RateOption = 20.0,
    memory_mb: MemoryOption = None,
    plot: PlotOption = None,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Measure speed on this machine, as ratios between things measured in one run.

    render: views of test rooms or of a log from 8 source views, by the reference renderer and by the streaming one at
    the same weights. fusion: 640x480 frames into 2 cm voxels, our fusion with 20 and 40 classes against Open3D's own
    without any. pipeline: whole steps, 640x480 frames with depth in, the semantic map out. growth: steps as one setting
    grows. map: a long walk through a building and back; time and memory by minute, and whether rooms that it comes back
    to are as it left them. virtual: what virtual views bring to maps, and what more rays or frames bring instead.
    queries: how long another process waits for answers while frames are mapped at full rate, and what a step pays.
    evidence: what each voxel_map.evidence costs in memory and in the quality of maps.
    depthless: how good a map's surface is where frames lose their depth.

    Quote ratios, not seconds: seconds depend on the machine and on what else it does. In the JSON the figures stand
    under the name of the part; of render, fusion or pipeline alone at the top, too.

    Example: semantic-mapper bench --out runs/bench.json
    Example: semantic-mapper bench pipeline --frames 40 --quality fast
    Example: semantic-mapper bench pipeline --depth computed
    Example: semantic-mapper bench queries --frames 60 --rate 20 --out runs/queries.json
    Example: semantic-mapper bench growth --frames 8 --width 160 --plot runs/growth.png
    Example: semantic-mapper bench map --rooms 4 --loops 1 --minutes 2 --quality fast --memory-mb 200
    """
    output = Output.guarded()
    from research.bench.walk import WalkPlan
    from research.cli.run_bench import MEASUREMENTS, BenchRequest, QueriesRequest, RenderRequest
    from semantic_mapper.nodes.cli.outputs import prepare_file
    from semantic_mapper.nodes.cli.run_replay import mapper_config

    out, output.quiet = results_file(out), json
    for path in (plot, out):
        if path is not None:
            prepare_file(path)
    plan = WalkPlan(rooms or 30, loops, minutes, hz, width or 320)
    if depth is not None and part is not Part.PIPELINE:
        raise typer.BadParameter("goes with pipeline", param_hint="--depth")
    settings = mapper_config(config, voxel_size, None, quality, depth, live=True)
    rendering, queries = RenderRequest(repeats, views or 1, log), QueriesRequest(rate, width or 640)
    virtual = (rooms or 4, views or 8)
    request = BenchRequest(weights, settings, rendering, frames, plan, memory_mb, plot, virtual, queries)
    wanted = QUICK if part is Part.ALL else (part,)
    found: dict[str, Any] = {one.value: MEASUREMENTS[one.value](request, output) for one in wanted}
    if part in QUICK:
        found |= found[part.value]
    _finish(found, output, out)


def _finish(found: dict[str, Any], output: Output, out: Path | None) -> None:
    """Say where it was measured, and write the file."""
    from semantic_mapper.files import write_json
    from semantic_mapper.replay.artifacts import versions

    found["machine"] = {"cpu": cpu_name(), "versions": versions()}
    output.print(f"on {found['machine']['cpu']}")
    if out is not None:
        write_json(out, found)
        output.print(f"written to {out}")
    if output.quiet:
        output.json(found)


def cpu_name() -> str:
    """Model name of the processor."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
