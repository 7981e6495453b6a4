"""``semantic-mapper launch``: the launch files that come with the package."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Annotated

import typer

from semantic_mapper.nodes.cli.verb import verb
from semantic_mapper.nodes.console import Output

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Launch files that come with the package; `semantic-mapper up NAME` starts one.",
)

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="As `semantic-mapper launch list` shows it.")]


@app.command("list")
@verb
def list_(
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> None:
    """Show the names of the launch files, and what each is for.

    Example: semantic-mapper launch list
    """
    output = Output.guarded()
    from rich.box import SIMPLE
    from rich.table import Table

    from semantic_mapper.nodes.launcher.launch_file import launch_files

    files = launch_files()
    if json:
        output.json({name: str(path) for name, path in files.items()})
        return
    table = Table("name", "what", box=SIMPLE, pad_edge=False)
    for name, path in files.items():
        table.add_row(name, _first_sentence(path))
    output.print(table)


@app.command("show")
@verb
def show(name: NameArgument) -> None:
    """Print a launch file.

    Example: semantic-mapper launch show replay
    """
    output = Output.guarded()
    for line in _find(name).read_text(encoding="utf-8").splitlines():
        output.print(line)


@app.command("copy")
@verb
def copy(
    name: NameArgument,
    to: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="The new file.  [default: NAME.toml]")] = None,
) -> None:
    """Copy a launch file, to change it.

    Example: semantic-mapper launch copy camera robot.toml
    """
    output = Output.guarded()
    from semantic_mapper.errors import ConfigError

    source = _find(name)
    target = to or Path(source.name)
    try:
        with target.open("xb") as file:
            file.write(source.read_bytes())
    except FileExistsError:
        raise ConfigError(f"{target}: exists already; name another file") from None
    output.print(str(target))


def _find(name: str) -> Path:
    from semantic_mapper.nodes.launcher.launch_file import find_launch, launch_files

    files = launch_files()
    return files[name] if name in files else find_launch(Path(name))


def _first_sentence(path: Path) -> str:
    """Of the comment that a file begins with."""
    lines = itertools.takewhile(lambda line: line.startswith("# "), path.read_text(encoding="utf-8").splitlines())
    return re.split(r"[.:;](?:\s|$)", " ".join(line[2:].strip() for line in lines), maxsplit=1)[0]
