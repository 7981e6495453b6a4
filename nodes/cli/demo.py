"""``semantic-mapper demo``: a recorded log goes the whole way, from camera frames to a map."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.cli.replay import VoxelSizeOption, WeightsOption
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.process import StopRequest


@verb
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")] = Path("runs/demo"),
    weights: WeightsOption = None,
    voxel_size: VoxelSizeOption = None,
) -> int:
    """Map a recorded log that comes with the package: a depth camera in a furnished room.

    Ends with a map, a picture and a summary in OUT. Needs no camera, no data and no network.

    Example: semantic-mapper demo --out runs/demo
    """
    output = Output.guarded()
    from semantic_mapper.nodes.cli.outputs import prepare_folder
    from semantic_mapper.nodes.cli.run_replay import ReplayRequest, mapper_config, replay_log
    from semantic_mapper.nodes.cli.summary_table import notes, result_lines, summary_table
    from semantic_mapper.replay.log.demo import demo_log

    began = time.monotonic()
    prepare_folder(out)
    with StopRequest() as stop:
        request = ReplayRequest(demo_log(), out, weights, mapper_config(None, voxel_size))
        with frame_progress("map", None) as bar:
            summary = replay_log(request, stop, bar.start, bar.set)
        output.print(summary_table({"demo": summary}))
        for line in (*notes(summary), *result_lines(out), f"  {demo_log()}  (the log it was made from)"):
            output.print(line)
        ended = "stopped after" if stop else "done in"
        stderr_console().print(f"{ended} {time.monotonic() - began:.0f} s; next: README.md, `semantic-mapper --help`")
        return stop.exit_code
