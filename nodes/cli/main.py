"""The command ``semantic-mapper``. Each verb lives in a file of its own, which is loaded when the verb is named."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from semantic_mapper import __version__
from semantic_mapper.nodes.cli.verb import Settings

_MODULES = "semantic_mapper.nodes.cli"
# By verb: the function or group of verbs (MODULE:NAME), and what it does, as its own help begins.
VERBS: Mapping[str, tuple[str, str]] = {
    "demo": ("demo:demo", "Map a recorded log that comes with the package: a depth camera in a furnished room."),
    "map": ("mapping:map_", "Map a recording: a log, a film, or a folder or bag that `import` takes."),
    "compare": ("compare:compare", "Compare two runs of one log: counts, scores, and how far the maps are apart."),
    "up": ("up:up", "Start the nodes of a launch file as processes and watch over them until they end."),
    "view": ("view:view", "Show a running launch, a log or a saved map in a browser, until Ctrl-C."),
    "record": ("record:record", "Record what the nodes of a running launch publish, from outside."),
    "calibrate": ("calibrate:calibrate", "Calibrate cameras from images of a printed ChArUco board."),
    "import": ("importing:import_", "Make a log of a recording of another program, of a film, or of a damaged log."),
    "info": ("info:info", "Say what a log, a map or a file of boxes holds, or which weights a mapper uses."),
    "export": ("export:export", "Write a saved map, or a log, in a format of other programs."),
    "merge": ("export:merge", "Make one map of several: what all have measured adds up."),
    "query": ("query:query", "Ask a saved map, or that of a running mapper, what is where."),
    "refine": ("refine:refine", "Relabel a saved map by its shape, colour and votes."),
    "finetune": ("finetune:finetune", "Fit the field to a few labelled keyframes of a log."),
    "autolabel": ("autolabel:autolabel", "Label every frame of a log with weights, into a new log."),
    "label": ("label:label", "Label frames of a log by hand (--serve), or say which to label (--suggest)."),
    "eval": (
        "eval:evaluate",
        "Score runs and logs: print a table of figures, and write them as JSON and as a page of HTML.",
    ),
    "bench": ("bench:bench", "Measure speed on this machine, on frames of 640x480."),
    "fleet": ("fleet:app", "Map, score, label and finetune many logs, on this machine or a Ray cluster."),
    "keys": ("keys:keys", "Make, show or exchange the keys by which machines know each other."),
    "doctor": ("doctor:doctor", "Look for what this machine lacks, with a fix for each thing; or list its cameras."),
}
# Coordinates below 0 and keys look like options.
_FREE_ARGUMENTS = ("query", "keys")


class _Group(TyperGroup):
    """Loads a verb when it is used."""

    def list_commands(self, ctx: Any) -> list[str]:
        """As of Click."""
        return list(VERBS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """As of Click."""
        if cmd_name not in VERBS:
            return None
        if cmd_name not in self.commands:
            module, _, attribute = VERBS[cmd_name][0].partition(":")
            found = getattr(import_module(f"{_MODULES}.{module}"), attribute)
            if not isinstance(found, typer.Typer):
                settings = {"ignore_unknown_options": True} if cmd_name in _FREE_ARGUMENTS else {}
                function, found = found, typer.Typer(add_completion=False, rich_markup_mode=None)
                found.command(cmd_name, context_settings=settings)(function)
            command = typer.main.get_command(found)
            command.name = cmd_name
            self.commands[cmd_name] = command
        return self.commands[cmd_name]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """As of Click, from what is known without loading a verb."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in VERBS.items()])


app = typer.Typer(
    name="semantic-mapper",
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"semantic-mapper {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log more, and show where an error arose.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Posed camera frames in, live semantic 3D map out.

    Start with `semantic-mapper demo`. Each verb explains itself: `semantic-mapper map --help`. Results go to
    stdout, messages to stderr. Exit codes: 0 done (`up`: also after Ctrl-C), 1 failed, 2 wrong usage, 3 a map that
    cannot be trusted (`map`), 130 Ctrl-C.
    """
    Settings.verbose = verbose


def main() -> None:
    """Entry point of the command."""
    app()
