"""``semantic-mapper view``: a running launch, a log or a saved map in the browser, or a launch as a table."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Self

import rich.live
import typer

from semantic_mapper.config import load_mapper_config
from semantic_mapper.errors import ConfigError, TransportError
from semantic_mapper.nodes.cli.options import MaxFramesOption, Remote, WeightsOption
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.launcher.running import (
    LaunchView,
    launch_folder,
    node_endpoints,
    read_launch_note,
    status_endpoint,
)
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.viewer.server import WebViewer
from semantic_mapper.replay.run_folder import is_log, is_map, map_path
from semantic_mapper.transport.sockets import NewestSubscriber

if TYPE_CHECKING:
    from rerun import RecordingStream

    from semantic_mapper.nodes.viewer.sources import Live

LEAST_MEMORY_MB = 64
POLL_S = 0.2
ANSWER_S = 5.0  # how long the launcher may take to say anything
STATUS_REFRESH_S = 0.5
FILE_WIDTH = 140  # columns of the table where nothing says how many there are


@verb
def view(
    remote: Remote,
    source: Annotated[
        str,
        typer.Argument(
            help="A log (.mcap, or a folder with the parts of one), a saved map (.npz, or a folder with map.npz), the "
            "socket folder of a running launch, or where a mapper answers (tcp://...); by default the one launch that "
            "runs here."
        ),
    ] = "",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the web page; 0 = any that is free.")] = 9090,
    data_port: Annotated[
        int, typer.Option(min=0, max=65535, hidden=True, help="Of the data that the page shows; 0 = any that is free.")
    ] = 9876,
    memory: Annotated[
        int,
        typer.Option(metavar="MB", min=LEAST_MEMORY_MB, hidden=True, help="For what is shown; then the oldest goes."),
    ] = 512,
    refresh: Annotated[float, typer.Option(metavar="S", min=0.2, hidden=True, help="Seconds between two maps.")] = 2.0,
    query: Annotated[str, typer.Option(hidden=True, help="Launch: name of the mapper's `query` endpoint.")] = "query",
    weights: WeightsOption = None,
    config: Annotated[Path | None, typer.Option(help="Log: TOML file with settings of the mapper.")] = None,
    max_frames: MaxFramesOption = 0,
    status: Annotated[
        bool, typer.Option("--status", help="Launch: show how its nodes are, as a table in this terminal.")
    ] = False,
    once: Annotated[bool, typer.Option("--once", help="--status: show it once and end.")] = False,
    json: Annotated[bool, typer.Option("--json", help="--status --once: one JSON document instead.")] = False,
) -> None:
    """Show a running launch, a log or a saved map in a browser, until Ctrl-C.

    Images, rendered semantics, depth, the camera's path, the map and stage times are shown.
    The map has a tab for each of its colourings: class, camera colour, confidence, and age, that is, how long ago its
    surroundings last changed while they were watched (a saved map has none). A log is mapped while it is shown. The
    page is served on this machine alone, and sends nothing anywhere; to see it from another one, tunnel both ports.

    With --status, twice a second: states, restarts, memory, rates, ages and losses of each node. frame: time since the
    last one; age: of the last one when it was mapped; beat: since the last sign of life. A launch on another machine is
    named by its endpoint (`publish` of the launch file).

    Example: semantic-mapper view
    Example: semantic-mapper view kitchen.mcap --weights kitchen.safetensors
    Example: semantic-mapper view tcp://robot:5570 --server robot
    Example: semantic-mapper view --status
    Example: ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 robot semantic-mapper view
    """
    if (once and not status) or (json and not once):
        raise typer.BadParameter("goes with --status --once" if json else "goes with --status", param_hint="--once")
    if status:
        _show_status(source, remote, once=once, json=json)
        return
    path = Path(source)
    log = bool(source) and is_log(path)
    if not log and (weights or config or max_frames):
        raise typer.BadParameter("go with a log", param_hint="--weights, --config, --max-frames")
    if remote.server and "://" not in source:
        raise typer.BadParameter("goes with an endpoint such as tcp://robot:5570", param_hint="--server")
    output = Output.guarded()
    saved = None if log else _saved_map(path, source)
    if source and "://" not in source and not path.exists():
        other = "" if log or saved else ", and no socket folder of a launch"
        raise ConfigError(f"{path}: no such file{other}; without a name, `view` shows the one launch that runs here")
    live = None if log or saved else _find_live(source, query, remote)
    with StopRequest() as stop, _Page(port, data_port, memory, output) as page:
        if saved is not None:
            from semantic_mapper.nodes.viewer.sources import show_saved

            show_saved(saved, page.begin)
        elif live is None:
            _show_log(path, weights, config, max_frames, page, refresh, stop)
        else:
            from semantic_mapper.nodes.viewer.sources import show_live

            show_live(live, page.begin, refresh, stop, output.print)
        while not stop:
            if not page.alive:
                raise TransportError("the process that serves the viewer has ended; start `view` again")
            time.sleep(POLL_S)


class _Page:
    """The page, served from when there is something to show on it; a context manager."""

    def __init__(self, port: int, data_port: int, memory_mb: int, output: Output) -> None:
        self._settings = port, data_port, memory_mb
        self._output = output
        self._ends = ExitStack()
        self._viewer: WebViewer | None = None

    @property
    def alive(self) -> bool:
        """Whether it is served."""
        return self._viewer is not None and self._viewer.alive

    def begin(self) -> RecordingStream:
        """Serve it, say where, and tell what writes on it.

        Raises:
            DependencyError, TransportError: see ``WebViewer``.
        """
        from semantic_mapper.replay.exporters.rerun_log import recording_server

        self._viewer = self._ends.enter_context(WebViewer(*self._settings))
        self._output.address("watch at", self._viewer.page_url)
        stream = recording_server(self._viewer.data_url)
        self._ends.callback(stream.disconnect)  # before its server ends, which it would complain of at length
        return stream

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ends.close()


def _saved_map(path: Path, source: str) -> Path | None:
    """The file of a saved map, where the source is one."""
    return map_path(path) if source and is_map(path) else None


def _find_live(source: str, query: str, remote: Remote) -> Live:
    """Endpoints of a running launch, or of a mapper anywhere.

    Raises:
        TransportError: none runs here, several do, or the folder is not that of a launch.
    """
    folder = None if "://" in source else launch_folder(source)
    from semantic_mapper.nodes.viewer.sources import Live

    if folder is None:
        return Live(source, (), remote.identity())
    nodes = node_endpoints(folder)
    streams = sum(camera in nodes for camera in read_launch_note(folder).names("camera"))
    return Live(f"ipc://{folder}/{query}", tuple(nodes.values()), streams=streams)


def _show_log(
    path: Path,
    weights: Path | None,
    config: Path | None,
    max_frames: int,
    page: _Page,
    refresh: float,
    stop: StopRequest,
) -> None:
    from semantic_mapper.nodes.viewer.mapped_log import show_log

    settings = load_mapper_config(config)
    with frame_progress("map", None) as bar:
        show_log(path, weights, settings, max_frames, page.begin, refresh, lambda: not stop and page.alive, bar)


def _show_status(place: str, remote: Remote, *, once: bool, json: bool) -> None:
    """A running launch as a table.

    Raises:
        TransportError: none runs here, several do, or nobody answers.
    """
    output = Output.guarded()
    if not output.console.is_terminal:
        output.console.width = FILE_WIDTH
    endpoint = status_endpoint(place)
    view = LaunchView()
    with NewestSubscriber(endpoint, ("status",), identity=remote.identity()) as subscriber:
        _wait_for_all(view, subscriber, endpoint)
        if json:
            output.json(view.to_json())
        elif once:
            output.print(view.table())
        else:
            _follow(view, subscriber, output)


def _wait_for_all(view: LaunchView, subscriber: NewestSubscriber, endpoint: str) -> None:
    waited = 0.0
    while not view.complete:
        if waited > ANSWER_S:
            raise TransportError(f"{endpoint}: no launcher has reported its nodes for {ANSWER_S:g} s; does it run?")
        view.listen(subscriber, STATUS_REFRESH_S)
        waited += STATUS_REFRESH_S


def _follow(view: LaunchView, subscriber: NewestSubscriber, output: Output) -> None:
    with StopRequest() as stop, rich.live.Live(view.table(), console=output.console, auto_refresh=False) as live:
        while not stop and not view.ended and view.silent_s < ANSWER_S:
            view.listen(subscriber, STATUS_REFRESH_S)
            live.update(view.table(), refresh=True)
    if not stop:
        output.print("the launch has ended" if view.ended else "the launcher says nothing any more")
