"""``semantic-mapper demo``: a recorded log goes the whole way, from camera frames to a map."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.options import MapperSettings, WeightsOption
from semantic_mapper.nodes.cli.replay import show_replay
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log import demo_log
from semantic_mapper.replay.run_folder import prepare_folder


@verb
def demo(
    mapper: MapperSettings,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")] = Path("runs/demo"),
    weights: WeightsOption = None,
) -> int:
    """Map a recorded log that comes with the package: a depth camera in a furnished room.

    Ends with a map, a picture and a summary in OUT. Needs no camera, no data and no network.

    Example: semantic-mapper demo --out runs/demo
    """
    output = Output.guarded()
    from semantic_mapper.replay.jobs import replay_log

    began = time.monotonic()
    prepare_folder(out)
    with StopRequest() as stop:
        with frame_progress("map", None, stop=stop) as bar:
            summary = replay_log(demo_log(), out, weights, mapper.load(), monitor=bar).summary
        show_replay(output, summary, out)
        output.print(f"  {demo_log()}  (the log it was made from)")
        ended = "stopped after" if stop else "done in"
        stderr_console().print(f"{ended} {time.monotonic() - began:.0f} s; next: README.md, `semantic-mapper --help`")
        return stop.exit_code
