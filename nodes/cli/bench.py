"""``semantic-mapper bench``: measure speed on this machine, as ratios between things measured in one run."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Literal

from semantic_mapper.config import AtLeastOne
from semantic_mapper.nodes.cli.verb import JsonOutput, MapperSettings, WeightsOption, must_be_there, verb
from semantic_mapper.replay.log import demo_log


@verb
def bench(
    output: JsonOutput,
    mapper: MapperSettings,
    part: Literal["fusion", "pipeline"] = "pipeline",  # what to measure
    *,
    log: Path | None = None,  # log with depth to measure on; without it that of `demo`
    frames: AtLeastOne = 20,  # frames that count
    weights: WeightsOption = None,
) -> None:
    """Measure speed on this machine.

    On frames of 640x480. fusion: frames into 2 cm voxels, ours with 20 and 40 classes against Open3D's own without any.
    pipeline: whole steps, frames in, the semantic map out. Quote ratios, not seconds: seconds depend on the machine and
    its load.

    Example: semantic-mapper bench pipeline --frames 30 --quality fast
    Example: semantic-mapper bench fusion --json
    """
    must_be_there(*(path for path in (log, mapper.path) if path is not None))
    from semantic_mapper.replay.artifacts import versions
    from semantic_mapper.replay.bench import bench_fusion, bench_pipeline

    log = log or demo_log()
    if part == "fusion":
        found = bench_fusion(log, frames)
        ours = ", ".join(
            f"ours {found[f'ms_{n}']} ms with {n} ({middle} times; {low} to {high} in {found['repeats']} repeats)"
            for n, (middle, low, high) in ((n, found[f"ratio_{n}"]) for n in (20, 40))
        )
        voxels = f"{found['voxel_size_m'] * 100:g} cm voxels"
        output.print(f"fusion of 640x480 into {voxels}: Open3D {found['open3d_ms']} ms a frame without classes, {ours}")
    else:
        found = bench_pipeline(log, weights, mapper.load(), frames)
        stages = ", ".join(f"{name} {value}" for name, value in found["stages_ms"].items())
        score = "" if found["miou"] is None else f"mIoU {found['miou'] * 100:.1f} %; "
        output.print(
            f"pipeline at {found['size']}, {found['depth']} depth: {found['hz']} frames/s, a step {found['p50_ms']} ms "
            f"(p50), {found['p95_ms']} ms (p95); {score}stages in ms: {stages}"
        )
    found["machine"] = {"cpu": cpu_name(), "versions": versions()}
    output.print(f"on {found['machine']['cpu']}")
    output.json(found)


def cpu_name() -> str:
    """Model name of the processor."""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()
