"""``semantic-mapper view``: a running system, a log or a saved map in the browser."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Self

import typer

from semantic_mapper.errors import ConfigError, TransportError
from semantic_mapper.nodes.cli.remote import KeysOption, ServerOption, server_identity
from semantic_mapper.nodes.cli.replay import ConfigOption, MaxFramesOption, WeightsOption
from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output, frame_progress
from semantic_mapper.nodes.process import StopRequest

if TYPE_CHECKING:
    from rerun import RecordingStream

    from semantic_mapper.nodes.viewer.server import WebViewer
    from semantic_mapper.nodes.viewer.sources import Live

LEAST_MEMORY_MB = 64
POLL_S = 0.2

PortOption = Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the web page; 0 = any that is free.")]
DataPortOption = Annotated[
    int, typer.Option(min=0, max=65535, help="Of the data that the page shows; 0 = any that is free.")
]
MemoryOption = Annotated[
    int, typer.Option("--memory", metavar="MB", min=LEAST_MEMORY_MB, help="For what is shown; then the oldest goes.")
]
RefreshOption = Annotated[float, typer.Option("--refresh", metavar="S", min=0.2, help="Seconds between two maps.")]


@verb
def view(
    source: Annotated[
        str,
        typer.Argument(
            help="A log (.mcap, or a folder with the parts of one), a saved map (.npz, or a folder with map.npz), the "
            "socket folder of a running launch, or where a mapper answers (tcp://...); by default the one launch that "
            "runs here."
        ),
    ] = "",
    port: PortOption = 9090,
    data_port: DataPortOption = 9876,
    memory: MemoryOption = 512,
    refresh: RefreshOption = 2.0,
    query: Annotated[str, typer.Option(help="Launch: name of the mapper's `query` endpoint.")] = "query",
    weights: WeightsOption = None,
    config: ConfigOption = None,
    max_frames: MaxFramesOption = 0,
    server: ServerOption = "",
    keys: KeysOption = None,
) -> None:
    """Show images, rendered semantics, depth, the camera's path, the map and stage times in a browser, until Ctrl-C.

    The map has a tab for each of its colourings: class, camera colour, confidence, and age, that is, how long ago its
    surroundings last changed while they were watched (a saved map has none). A log is mapped while it is shown. The
    page is served on this machine alone, and sends nothing anywhere; to see it from another one, tunnel both ports.

    Example: semantic-mapper view
    Example: semantic-mapper view runs/demo
    Example: semantic-mapper view kitchen.mcap --weights kitchen.safetensors
    Example: semantic-mapper view tcp://robot:5570 --server robot
    Example: ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 robot semantic-mapper view
    """
    path = Path(source)
    log = _is_log(source)
    if not log and (weights or config or max_frames):
        raise typer.BadParameter("go with a log", param_hint="--weights, --config, --max-frames")
    if server and "://" not in source:
        raise typer.BadParameter("goes with an endpoint such as tcp://robot:5570", param_hint="--server")
    output = Output.guarded()
    saved = None if log else _saved_map(path, source)
    if source and "://" not in source and not path.exists():
        other = "" if log or saved else ", and no socket folder of a launch"
        raise ConfigError(f"{path}: no such file{other}; without a name, `view` shows the one launch that runs here")
    live = None if log or saved else _find_live(source, query, server, keys)
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
        from semantic_mapper.nodes.viewer.server import WebViewer
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


def _is_log(source: str) -> bool:
    from semantic_mapper.replay.run_folder import is_log

    return bool(source) and is_log(Path(source))


def _saved_map(path: Path, source: str) -> Path | None:
    """The file of a saved map, where the source is one."""
    from semantic_mapper.replay.run_folder import is_map, map_path

    return map_path(path) if source and is_map(path) else None


def _find_live(source: str, query: str, server: str, keys: Path | None) -> Live:
    """Endpoints of a running launch, or of a mapper anywhere.

    Raises:
        TransportError: none runs here, several do, or the folder is none of a launch.
    """
    from semantic_mapper.nodes.launcher.running import launch_folder, node_endpoints, read_launch_note

    folder = None if "://" in source else launch_folder(source)
    from semantic_mapper.nodes.viewer.sources import Live

    if folder is None:
        return Live(source, (), server_identity(server, keys))
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
    from semantic_mapper.config import load_mapper_config
    from semantic_mapper.nodes.viewer.mapped_log import show_log

    settings = load_mapper_config(config)
    with frame_progress("map", None) as bar:
        show_log(
            path,
            weights,
            settings,
            max_frames,
            page.begin,
            refresh,
            going=lambda: not stop and page.alive,
            on_start=bar.start,
            on_frame=bar.set,
        )
