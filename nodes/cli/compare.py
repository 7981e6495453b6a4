"""``semantic-mapper compare``: do two runs of one log come to the same?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.nodes.cli.verb import show_error, verb
from semantic_mapper.nodes.console import Output

if TYPE_CHECKING:
    from rich.table import Table

    from semantic_mapper.replay.compare.runs import Comparison
    from semantic_mapper.replay.compare.tolerances import Tolerances

EXIT_DIFFERS = 1
EXIT_TROUBLE = 2

RunArgument = typer.Argument(help="Folder that `replay` or `up` has written, or a map.npz.")


@verb
def compare(
    a: Annotated[Path, RunArgument],
    b: Annotated[Path, RunArgument],
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            "--tolerance", "-t", metavar="FIELD=VALUE", help="Allow so much; inf = anything. May be repeated."
        ),
    ] = None,
    tolerances: Annotated[Path | None, typer.Option(metavar="TOML", help="File of tolerances by field.")] = None,
    exact: Annotated[bool, typer.Option("--exact", help="Nothing may differ, down to each bit of the maps.")] = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Where to draw; else compare.png beside B's map.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")] = False,
) -> int:
    """Compare two runs of one log, field by field, and draw where their maps differ.

    Runs are equal where frames, metrics, blocks, surface, classes and confidence are within their tolerances: 0 for
    counts, little for the rest, so that another machine passes; `-t labels=0.05` sets one. In fields of the maps, A is
    told as seen from A's surface and blocks, B from B's. Exit codes: 0 equal, 1 different, 2 wrong usage, or something
    that cannot be read or written.

    Example: semantic-mapper compare runs/before runs/after
    Example: semantic-mapper compare runs/before runs/after -t labels=0.05 -t confidence=inf
    Example: semantic-mapper compare a/map.npz b/map.npz --exact --json
    """
    if exact and (tolerance or tolerances):
        raise typer.BadParameter("leaves nothing to tolerate", param_hint="--exact")
    output = Output.guarded()
    try:
        comparison, drawn = _compare(a, b, _read_tolerances(tolerances, tolerance or []), exact, picture)
    except SemanticMapperError as error:
        show_error(str(error))
        return EXIT_TROUBLE
    if json:
        output.json({**comparison.to_plain(), "picture": str(drawn)})
    else:
        output.print(comparison_table(comparison))
        for line in (*comparison.notes, *_changes(comparison), f"  {drawn}  (where they differ)"):
            output.print(line)
        output.print("equal" if comparison.equal else "different: " + ", ".join(_differing(comparison)))
    return 0 if comparison.equal else EXIT_DIFFERS


def comparison_table(comparison: Comparison) -> Table:
    """One row a field; those that differ are red."""
    from rich.table import Table

    table = Table(title=f"A {comparison.a.name}, B {comparison.b.name}", title_justify="left")
    table.add_column("field")
    for name in ("A", "B", "difference", "allowed"):
        table.add_column(name, justify="right")
    for field in comparison.fields:
        table.add_row(field.title, *field.texts(), style="" if field.within else "red")
    return table


def _compare(a: Path, b: Path, tolerances: Tolerances, exact: bool, picture: Path | None) -> tuple[Comparison, Path]:
    from semantic_mapper.plots import write_picture
    from semantic_mapper.replay.compare.picture import draw_comparison
    from semantic_mapper.replay.compare.runs import compare_runs, read_run
    from semantic_mapper.replay.run_folder import is_log, prepare_file

    for path in (a, b):
        if path.exists() and is_log(path):
            raise ConfigError(
                f"{path}: is a log, and `compare` takes maps or results of runs: `semantic-mapper replay {path} --out "
                "FOLDER` makes one, to be named here as FOLDER"
            )
    runs = read_run(a), read_run(b)
    drawn = picture or (b if b.is_dir() else b.parent) / "compare.png"
    prepare_file(drawn)
    comparison = compare_runs(*runs, tolerances, exact=exact)
    write_picture(drawn, draw_comparison(comparison))
    return comparison, drawn


def _read_tolerances(path: Path | None, settings: list[str]) -> Tolerances:
    """Those of the file with what the command line says on top."""
    from semantic_mapper.config import convert_config, read_toml
    from semantic_mapper.replay.compare.tolerances import Tolerances

    data = read_toml(path) if path else {}
    convert_config(data, Tolerances, str(path))
    for setting in settings:
        name, _, value = setting.partition("=")
        try:
            data[name] = float(value)
        except ValueError as error:
            raise ConfigError(f"--tolerance {setting}: write FIELD=VALUE with a number, such as labels=0.05") from error
    return convert_config(data, Tolerances, "--tolerance")


def _differing(comparison: Comparison) -> list[str]:
    return [field.name for field in comparison.fields if not field.within]


def _changes(comparison: Comparison) -> list[str]:
    return [f"{count:,} points of {mine} are {theirs} in B" for mine, theirs, count in comparison.label_changes[:5]]
