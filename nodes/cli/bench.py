"""``semantic-mapper bench``: measure speed on this machine, as ratios between things measured in one run."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from semantic_mapper.config import MapperConfig, NotNegative, nearest
from semantic_mapper.nodes.cli.verb import (
    JsonOutput,
    MapperSettings,
    WeightsOption,
    must_be_there,
    refuse_options,
    verb,
)
from semantic_mapper.nodes.console import Output, frame_progress, table
from semantic_mapper.replay.log import demo_log

# Columns of a table: name, field of the JSON, and its unit in that of the column.
_COSTS = (("peak MB", "peak_mb", 1), ("loaded", "loaded_mb", 1))
_SCORES = {
    "mapper": (("surface mm", "median_m", 1e3), ("complete %", "complete", 100), ("ghosts %", "ghosts", 100)),
    "odometry": (("RPE mm", "rpe_m", 1e3), ("RPE deg", "rpe_deg", 1), ("ATE mm", "ate_m", 1e3), ("lost", "lost", 1)),
}


@verb
def bench(
    output: JsonOutput,
    mapper: MapperSettings,
    part: Literal["fusion", "pipeline", "peers"] = "pipeline",  # what to measure
    log: Path | None = None,  # log with depth to measure on; without it that of `demo`
    *,
    frames: NotNegative = 0,  # frames that count; 0 = 20, of peers 200
    weights: WeightsOption = None,
    truth: Path | None = None,  # peers: reference mesh (.npz) of the surfaces
    # peers: Python of one that has an environment of its own
    python: Annotated[list[str] | None, typer.Option(metavar="NAME=PATH")] = None,
    out: Path | None = None,  # peers: folder of results.json and peers.png
) -> None:
    """Measure speed on this machine.

    fusion: frames into 2 cm voxels, ours with 20 and 40 classes against Open3D's own without any. pipeline: whole
    steps, frames in, the semantic map out. Both resize frames to 640x480. peers: a log through other mappers and
    odometries, as it is (docs/peers.md). Quote ratios, not seconds: seconds depend on the machine and its load.

    Example: semantic-mapper bench pipeline --frames 30 --quality fast
    Example: semantic-mapper bench peers kitchen.mcap --out runs/peers
    """
    of_peers = truth is not None or python or out is not None
    refuse_options((of_peers and part != "peers", "--truth, --python, --out", "go with peers"))
    must_be_there(*(path for path in (log, mapper.path, truth) if path is not None))
    from semantic_mapper.replay.artifacts import versions
    from semantic_mapper.replay.bench import bench_fusion, bench_pipeline
    from semantic_mapper.replay.peers.comparison import write_peers

    log = log or demo_log()
    if part == "peers":
        found = _bench_peers(output, mapper.load(), log, frames or 200, truth, python or [])
    elif part == "fusion":
        found = bench_fusion(log, frames or 20)
        ours = ", ".join(
            f"ours {found[f'ms_{n}']} ms with {n} ({middle} times; {low} to {high} in {found['repeats']} repeats)"
            for n, (middle, low, high) in ((n, found[f"ratio_{n}"]) for n in (20, 40))
        )
        voxels = f"{found['voxel_size_m'] * 100:g} cm voxels"
        output.print(f"fusion of 640x480 into {voxels}: Open3D {found['open3d_ms']} ms a frame without classes, {ours}")
    else:
        found = bench_pipeline(log, weights, mapper.load(), frames or 20)
        stages = ", ".join(f"{name} {value}" for name, value in found["stages_ms"].items())
        score = "" if found["miou"] is None else f"mIoU {found['miou'] * 100:.1f} %; "
        output.print(
            f"pipeline at {found['size']}, {found['depth']} depth: {found['hz']} frames/s, a step {found['p50_ms']} ms "
            f"(p50), {found['p95_ms']} ms (p95); {score}stages in ms: {stages}"
        )
    found["machine"] = {"cpu": cpu_name(), "versions": versions()}
    output.print(f"on {found['machine']['cpu']}")
    if out is not None:
        write_peers(out, found)
        output.print(f"written to {out}")
    output.json(found)


def _bench_peers(
    output: Output, config: MapperConfig, log: Path, frames: int, truth: Path | None, python: list[str]
) -> dict[str, Any]:
    """Measure, and show a table for each kind and one of what did not run."""
    from semantic_mapper.replay.peers.comparison import PEERS, compare_peers, read_frames

    pythons = {name: path for name, _, path in (item.partition("=") for item in python)}
    refuse_options(
        *((name not in PEERS, "--python", f"no peer {name!r}{nearest(name, list(PEERS))}") for name in pythons)
    )
    with frame_progress("measure", None, "runs") as bar:
        given = read_frames(log, frames)[0], config.voxel_map
        found = compare_peers(*given, truth=truth, pythons=pythons, seed=config.seed, monitor=bar)
    for kind, scores in _SCORES.items():
        names = (kind, "CPU ms", "least", "most", *(name for name, _, _ in (*_COSTS, *scores)))
        rows = [
            (row["title"], *(f"{value:.4g}" for value in row["cpu_ms"]), *_cells(row, (*_COSTS, *scores)))
            for row in found["peers"]
            if row["kind"] == kind and row["cpu_ms"]
        ]
        output.print(table(rows, names, numbers=names[1:]))
    absent = [(row["title"], row["problem"], row["install"]) for row in found["peers"] if "problem" in row]
    if absent:
        output.print(table(absent, ("not measured", "why", "install")))
    if truth is None:
        output.print("surfaces are not compared: --truth gives a mesh")
    output.print(
        f"{found['frames']} frames, {config.voxel_map.voxel_size_m:g} m voxels, one thread; CPU ms a frame; {log}"
    )
    return found


def _cells(row: dict[str, Any], columns: Iterable[tuple[str, str, float]]) -> list[str | None]:
    values = [(row.get(name), unit) for _, name, unit in columns]
    return [None if value is None else f"{round(value * unit, 2):.4g}" for value, unit in values]


def cpu_name() -> str:
    """Model name of the processor."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
