"""``semantic-mapper demo``: the recorded room that comes with the package, as a map or as a robot that runs."""

import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from semantic_mapper.nodes.cli.up import run_launch
from semantic_mapper.nodes.cli.verb import MapperSettings, WeightsOption, refuse_options, verb
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.launcher.launch_file import find_launch, load_launch
from semantic_mapper.nodes.launcher.liveness import end_with_launcher
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer.server import end_process
from semantic_mapper.replay.log import demo_log
from semantic_mapper.replay.run_folder import prepare_folder
from semantic_mapper.replay.summary import ending
from semantic_mapper.transport.launches import LIVE, running_launches

LAUNCH = Path("camera")  # that of the package
RATE = 0.3  # of the recorded time: its 24 frames last 5 s, and half of a core is left for the viewer
VIEW = "from semantic_mapper.nodes.cli.main import main; main()"


@verb
def demo(
    output: Output,
    mapper: MapperSettings,
    *,
    live: bool = False,  # map it again and again, as on a robot, and show it in a browser, until Ctrl-C
    out: Path | None = None,  # folder for the results [runs/demo; runs/demo-live]; made if missing
    weights: WeightsOption = None,
) -> int:
    """Map a recorded log that comes with the package.

    It is of a depth camera in a furnished room. Ends with a map, a picture and a summary in OUT. Needs no camera, no
    data and no network.

    With --live, camera, mapper and viewer are processes that run until Ctrl-C, which writes the map; meanwhile another
    terminal asks it: `semantic-mapper query live nearest chair 0 0 1`. It is the launch file `camera` with a log in
    place of the camera: `up` has it with any setting.

    Example: semantic-mapper demo --out runs/demo
    Example: semantic-mapper demo --live
    """
    if live:
        given = bool(mapper.given or mapper.path)
        refuse_options((given, "--live", "has the settings of its launch file: `up camera` takes others"))
        _run_live(output, out or Path("runs/demo-live"), weights)
        return 0
    from semantic_mapper.replay.map_log import replay_log

    began, out = time.monotonic(), out or Path("runs/demo")
    prepare_folder(out)
    with StopRequest() as stop:
        with frame_progress("map", None, stop=stop) as bar:
            summary, _ = replay_log(demo_log(), out, weights, mapper.load(), monitor=bar)
        for line in ending(summary, out):
            output.print(line)
        output.print(f"log: {demo_log()}")
        ended = "stopped after" if stop else "done in"
        stderr_console().print(
            f"{ended} {time.monotonic() - began:.0f} s; next: `semantic-mapper query {out} nearest chair 0 0 1`"
        )
        return stop.exit_code


def _run_live(output: Output, out: Path, weights: Path | None) -> None:
    settings = [f"camera.log={demo_log()}", "camera.loop=true", f"camera.rate={RATE}"]
    settings += [f"mapper.weights={weights}"] if weights else []
    with ExitStack() as stack:
        run_launch(output, load_launch(find_launch(LAUNCH), settings, out), partial(_show_live, stack))


def _show_live(stack: ExitStack, folder: Path) -> None:
    """Start the viewer of a launch that runs, and say what else can be done with it."""
    viewer = subprocess.Popen(
        [sys.executable, "-I", "-c", VIEW, "view", str(folder)],
        stdin=subprocess.DEVNULL,
        process_group=0,  # Ctrl-C is for the launcher
        preexec_fn=partial(end_with_launcher, signal.SIGTERM),
    )
    stack.callback(end_process, viewer)
    program = "semantic-mapper" if shutil.which("semantic-mapper") else sys.argv[0]
    place = LIVE if len(running_launches()) == 1 else str(folder)
    console = stderr_console()
    console.print("the room is mapped again and again until Ctrl-C; meanwhile, in another terminal:", style="bold")
    for words in (f"query {place} nearest chair 0 0 1", f"query {place} info", f"view {place} --status"):
        console.print(f"  {program} {words}")
