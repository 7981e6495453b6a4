"""``semantic-mapper up``: the nodes of a launch file as processes."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.config import load_config
from semantic_mapper.errors import EmptyMapError, SemanticMapperError
from semantic_mapper.nodes.cli.verb import complete, set_option, verb, wrong_usage
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.launcher.launch_file import Launch, LaunchFile, find_launch, launch_files, load_launch
from semantic_mapper.nodes.launcher.launcher import Launcher, Notifier
from semantic_mapper.nodes.options import OPTIONS, CameraOptions, LiveCamera, MapperOptions
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.run_folder import hold_folder
from semantic_mapper.replay.summary import ending, read_summary
from semantic_mapper.setting_docs import settings_of


def _launches(incomplete: str) -> list[str]:
    return [name for name in launch_files() if name.startswith(incomplete)]


def _settings(ctx: typer.Context, incomplete: str) -> list[str]:
    """What ``--set`` of the launch that is named may be; nothing where it cannot be read."""
    try:
        file = load_config(find_launch(Path("".join(ctx.args[:1]))), LaunchFile)
    except SemanticMapperError:
        return []
    found = [setting for setting in settings_of(LaunchFile) if setting.name != "node"]
    for node in file.node:
        for kind in (OPTIONS[node.kind], *((LiveCamera,) if node.kind == "camera" else ())):
            found += settings_of(kind, f"{node.name}.")
    return complete(found, incomplete)


@verb
def up(
    output: Output,
    # launch file, or the name of one of the package: camera, replay, ...; an unknown name lists all
    launch: Annotated[Path, typer.Argument(autocompletion=_launches)],
    *,
    set_: Annotated[list[str] | None, set_option(_settings)] = None,
    out: Path | None = None,  # folder for the results; the same as --set out=DIR
) -> None:
    """Start the nodes of a launch file, and watch over them.

    --set NODE.OPTION=VALUE sets an option of a node, --set NAME=VALUE one of the launch (`out`, `restart`, ...).
    Ctrl-C ends all nodes in order, the map so far is written, and the exit code is 0; a second Ctrl-C kills them. When
    a node fails, the others are ended in order too, the error says which one it was and why, and the exit code is 1;
    where the launch file says so it is restarted first (`restart`). The exit code is 1, too, where a recorder knows at
    its end that frames are not in its log, and 4 where a mapper mapped no frame. `semantic-mapper view --status` shows
    how the nodes are.

    Example: semantic-mapper up replay --set camera.log=kitchen.mcap --out runs/up
    Example: semantic-mapper up camera --set camera.kind=oak
    """
    with wrong_usage():
        checked = load_launch(find_launch(launch), set_ or (), out)
    run_launch(output, checked)


def run_launch(output: Output, launch: Launch, on_ready: Callable[[Path], None] = lambda folder: None) -> None:
    """Run a launch until it ends or somebody asks to stop, and show its results; ``on_ready`` as of ``Launcher``."""
    for options in launch.options.values():
        if isinstance(options, CameraOptions) and options.log:
            open_log(options.log).close()  # what is wrong with it is said before nodes start
    folders = [Path(o.out) for o in launch.options.values() if isinstance(o, MapperOptions)]
    before = [_written(f) for f in folders]
    with StopRequest() as stop, ExitStack() as stack:
        for folder in dict.fromkeys(f.resolve() for f in folders):
            stack.enter_context(hold_folder(folder))
        stack.enter_context(Launcher(launch, Notifier.from_environment(), on_ready)).run(stop)
    fresh = [f for f, stamp in zip(folders, before, strict=True) if _written(f) not in (0, stamp)]
    results = [(folder, read_summary(folder)) for folder in fresh]
    for folder, summary in results:
        for line in ending(summary, folder):
            output.print(line)
    for folder, summary in results:
        if not summary["frames"]["fused"] and not stop:
            why = [r["reason"] for r in summary["refusals"]] or summary["damaged_stretches"]
            why += [summary["map"]["nearly_empty"] or "no frames came"]
            count = summary["frames"]["published"]
            raise EmptyMapError(f"{folder}: none of {counted(count, 'frame')} was mapped; the first: {why[0]}")


def _written(folder: Path) -> int:
    """When the folder's summary was written, 0 = no summary."""
    file = folder / "summary.json"
    return file.stat().st_mtime_ns if file.exists() else 0
