"""``semantic-mapper view``: a running launch, a log or a saved map in the browser, or a launch as a table."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import rich.live

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import ConfigError, TransportError
from semantic_mapper.nodes.cli.verb import JsonOutput, Port, Remote, WeightsOption, refuse_options, verb, wrong_usage
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.launcher import running
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer.server import ViewerPage
from semantic_mapper.replay.run_folder import is_log, is_map, map_path
from semantic_mapper.transport.launches import STATUS_SOCKET, launch_folder, read_launch_note, socket_in_launch
from semantic_mapper.transport.sockets import NewestSubscriber

if TYPE_CHECKING:
    from semantic_mapper.nodes.viewer.sources import Live

ANSWER_S = 5.0  # how long the launcher may take to say anything
STATUS_REFRESH_S = 0.5
FILE_WIDTH = 140  # columns of the table where nothing says how many there are


@verb
def view(
    output: JsonOutput,
    remote: Remote,
    # log (.mcap) or folder of its parts, saved map or folder with one, socket folder of a running launch, or where a
    # mapper answers (tcp://...); by default the one launch that runs here
    source: str = "",
    *,
    port: Port | None = None,  # of the page; 0 = any that is free [9090, or any where that is taken]
    weights: WeightsOption = None,
    config: Path | None = None,  # log: TOML file with settings of the mapper
    status: bool = False,  # launch: show how its nodes are, as a table in this terminal
    once: bool = False,  # --status: show it once and end; also as --json
) -> None:
    """Show a running launch, a log or a saved map in a browser.

    Images, rendered semantics, depth, the camera's path, the map and stage times are shown. The map has a tab for each
    colouring: class, camera colour, confidence, and age: how long ago its surroundings last changed (a saved map has
    none). A log is mapped as by `map --view`, and nothing is kept. The page is served on this machine alone, and sends
    nothing anywhere; to see it from another one, tunnel both ports.

    With --status, twice a second: states, restarts, memory, rates, ages and losses of each node. frame: time since the
    last one; age: of the last one when it was mapped; beat: since the last sign of life. A launch on another machine is
    named by its endpoint (`publish` of the launch file).

    Example: semantic-mapper view
    Example: semantic-mapper view kitchen.mcap --weights kitchen.safetensors
    Example: semantic-mapper view tcp://robot:5570 --server robot
    Example: semantic-mapper view --status
    Example: ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 robot semantic-mapper view
    """
    refuse_options(((once and not status) or (output.quiet and not once), "--once and --json", "go with --status"))
    if status:
        _show_status(output, source, remote, once=once)
        return
    path = Path(source)
    log = bool(source) and is_log(path)
    saved = map_path(path) if source and not log and is_map(path) else None
    refuse_options(
        (not log and (weights or config), "--weights and --config", "go with a log"),
        (remote.server and "://" not in source, "--server", "goes with an endpoint such as tcp://robot:5570"),
    )
    if source and "://" not in source and not path.exists():
        other = "" if log or saved else ", and no socket folder of a launch"
        raise ConfigError(f"{path}: no such file{other}; without a name, `view` shows the one launch that runs here")
    live = None if log or saved else _find_live(source, remote)
    with StopRequest() as stop, ViewerPage(output, port) as page, ExitStack() as stack:
        if saved is not None:
            from semantic_mapper.nodes.viewer.sources import show_saved

            show_saved(saved, page.begin)
        elif live is None:
            from semantic_mapper.replay.jobs import replay_log

            with wrong_usage():
                settings = load_mapper_config(config)
            results = Path(stack.enter_context(TemporaryDirectory(prefix="semantic-mapper-view-")))
            with frame_progress("map", None, stop=stop) as bar:
                replay_log(path, results, weights, settings, watch=page.watch, monitor=bar)
        else:
            from semantic_mapper.nodes.viewer.sources import REFRESH_S, show_live

            show_live(live, page.begin, REFRESH_S, stop, output.print)
        page.wait(stop)


def _find_live(source: str, remote: Remote) -> Live:
    """Endpoints of a running launch, or of a mapper anywhere."""
    folder = None if "://" in source else launch_folder(source)
    from semantic_mapper.nodes.viewer.sources import Live

    if folder is None:
        return Live(source, (), remote.server, remote.keys)
    nodes = running.node_endpoints(folder)
    streams = sum(camera in nodes for camera in read_launch_note(folder).names("camera"))
    return Live(str(folder), tuple(nodes.values()), streams=streams)


def _show_status(output: Output, place: str, remote: Remote, *, once: bool) -> None:
    """A running launch as a table."""
    if not output.console.is_terminal:
        output.console.width = FILE_WIDTH
    endpoint = socket_in_launch(place, STATUS_SOCKET)
    view = running.LaunchView()
    with NewestSubscriber(endpoint, ("status",), identity=remote.identity()) as subscriber:
        deadline = time.monotonic() + ANSWER_S
        while not view.complete:
            if time.monotonic() > deadline:
                raise TransportError(f"{endpoint}: no launcher has reported its nodes for {ANSWER_S:g} s; does it run?")
            view.listen(subscriber, STATUS_REFRESH_S)
        if once:
            output.print(view.table())
            output.json(view.to_json())
            return
        with StopRequest() as stop, rich.live.Live(view.table(), console=output.console, auto_refresh=False) as live:
            while not stop and not view.ended and view.silent_s < ANSWER_S:
                view.listen(subscriber, STATUS_REFRESH_S)
                live.update(view.table(), refresh=True)
        if not stop:
            output.print("the launch has ended" if view.ended else "the launcher says nothing any more")
