"""``semantic-mapper view``: a running launch or a saved map in the browser, or a launch as a table."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich.live
import typer

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.cli.verb import JsonOutput, Port, Remote, complete_launch, refuse_options, verb
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.launcher import running
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer.server import ViewerPage
from semantic_mapper.replay.run_folder import is_log, is_map, map_path
from semantic_mapper.transport.launches import STATUS_SOCKET, launch_folder, read_launch_note, socket_in_launch
from semantic_mapper.transport.sockets import NewestSubscriber

if TYPE_CHECKING:
    from semantic_mapper.nodes.viewer.sources import Live


@verb
def view(
    output: JsonOutput,
    remote: Remote,
    # saved map or folder with one, running launch (its socket folder or file's name), or where a mapper answers
    # (tcp://...); by default the one launch that runs here
    source: Annotated[str, typer.Argument(autocompletion=complete_launch)] = "",
    *,
    port: Port | None = None,  # of the page; 0 = any that is free [9090, or any where that is taken]
    status: bool = False,  # launch: show how its nodes are, as a table in this terminal
    once: bool = False,  # --status: show it once and end; also as --json
) -> None:
    """Show a running launch or a saved map in a browser.

    Images, rendered semantics, depth, the camera's path, the map and stage times are shown. The map has a tab for each
    colouring: class, camera colour, confidence, and whether a sensor measured it. Boxes and arrows show what was moved,
    is new or has gone since the map of before. Of a log: `map --view`. The page is served on this machine alone, and
    asks no other; to see it from another one, tunnel both ports.

    With --status, twice a second: states, restarts, memory, rates, ages and losses of each node. frame: time since the
    last one; age: of the last one when it was mapped; beat: since the last sign of life. A launch on another machine is
    named by its endpoint (`publish` of the launch file).

    Example: semantic-mapper view
    Example: semantic-mapper view runs/kitchen
    Example: semantic-mapper view tcp://robot:5570 --server robot
    Example: semantic-mapper view --status
    Example: ssh -L 9090:localhost:9090 -L 9876:localhost:9876 robot
    """
    refuse_options(((once and not status) or (output.quiet and not once), "--once and --json", "go with --status"))
    if status:
        _show_status(output, source, remote, once=once)
        return
    path = Path(source)
    saved = map_path(path) if source and is_map(path) else None
    if source and not saved and is_log(path):
        raise ConfigError(
            f"{path}: is a log; `semantic-mapper map {shlex.quote(str(path))} --view` shows it while it is mapped"
        )
    refuse_options(
        (remote.server and "://" not in source, "--server", "goes with an endpoint such as tcp://robot:5570")
    )
    live = None if saved else _find_live(source, remote)
    from semantic_mapper.nodes.viewer.sources import REFRESH_S, show_live, show_saved

    with StopRequest() as stop, ViewerPage(output, port) as page:
        if live is None:
            show_saved(map_path(path), page.begin)
        else:
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
    endpoint = socket_in_launch(place, STATUS_SOCKET)
    with NewestSubscriber(endpoint, ("status",), identity=remote.identity()) as subscriber:
        view = running.LaunchView.whole(subscriber)
        if once:
            output.print(view.table())
            output.json(view.to_json())
            return
        with StopRequest() as stop, rich.live.Live(view.table(), console=output.console, auto_refresh=False) as live:
            while not stop and not view.ended and view.silent_s < running.ANSWER_S:
                view.listen(subscriber, running.LISTEN_S)
                live.update(view.table(), refresh=True)
        if not stop:
            output.print("the launch has ended" if view.ended else "the launcher says nothing any more")
