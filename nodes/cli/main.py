"""The command ``semantic-mapper``. Each verb lives in a file of its own, which is loaded when the verb is named."""

import io
import os
import re
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from functools import partial
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from semantic_mapper import __version__
from semantic_mapper.config import nearest
from semantic_mapper.nodes.cli.verb import Settings

_MODULES = "semantic_mapper.nodes.cli"
# By what a user is about: verbs, each with its function or group of verbs (MODULE:NAME) and what it does, as its own
# help begins.
GROUPS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "Map recordings": {
        "demo": ("demo:demo", "Map a recorded log that comes with the package."),
        "map": ("mapping:map_", "Map a recording: a log, a film, or what `import` takes."),
        "import": ("importing:import_", "Make a log of a film or of a recording of another program."),
        "eval": ("eval:evaluate", "Score logs and results of `map`, or compare two results."),
        "fleet": ("fleet:app", "Map, score, label and finetune many logs."),
    },
    "Live": {
        "calibrate": ("calibrate:calibrate", "Calibrate cameras from images of a printed ChArUco board."),
        "up": ("up:up", "Start the nodes of a launch file, and watch over them."),
        "view": ("view:view", "Show a running launch or a saved map in a browser."),
        "record": ("record:record", "Record what the nodes of a running launch publish."),
    },
    "Use a map": {
        "query": ("query:query", "Ask a saved map, or a running mapper, what is where."),
        "mcp": ("mcp:mcp", "Serve a map to an agent by the Model Context Protocol."),
        "info": ("info:info", "Say what a log, a map or weights hold."),
        "export": ("export:export", "Write a map, or a log, in a format of other programs."),
        "merge": ("export:merge", "Merge maps of one place into one map."),
        "scale": ("scale:scale", "Give the map of a film metres, and map it again."),
        "refine": ("refine:refine", "Relabel a saved map by its shape, colour and votes."),
    },
    "Teach it classes": {
        "label": ("label:label", "Label frames of a log by hand, or say which to label."),
        "finetune": ("finetune:finetune", "Fit weights to a few labelled keyframes of a log."),
        "autolabel": ("autolabel:autolabel", "Label every frame of a log with weights, into a new log."),
    },
    "This machine": {
        "doctor": ("doctor:doctor", "Say what this machine lacks, and the fix; list its cameras."),
        "keys": ("keys:keys", "Make, show or exchange keys, by which machines connect."),
        "bench": ("bench:bench", "Measure speed on this machine."),
    },
}
VERBS = {name: verb for verbs in GROUPS.values() for name, verb in verbs.items()}
# Coordinates below 0 and keys look like options.
_FREE_ARGUMENTS = ("query", "keys")
_SIGNS = ("=", ":")  # a word each in bash


class _Context(typer.Context):
    """Leaves more of a line for what options do."""

    def make_formatter(self) -> Any:
        """As of Click."""
        formatter = super().make_formatter()
        vars(formatter)["write_dl"] = partial(formatter.write_dl, col_max=24)
        return formatter


class _Group(TyperGroup):
    """Loads a verb when it is used."""

    def get_params(self, ctx: Any) -> list[Any]:
        """As of Click; README.md tells of --show-completion."""
        found = super().get_params(ctx)
        for parameter in found:
            vars(parameter)["hidden"] = parameter.name == "show_completion"
        return found

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
            for each in (command, *getattr(command, "commands", {}).values()):
                each.context_class = _Context
            self.commands[cmd_name] = command
        return self.commands[cmd_name]

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As of Click; a typo gets the nearest verb, of those that are not loaded, too."""
        if args[0] not in VERBS and not args[0].startswith("-"):
            ctx.fail(f"No such command '{args[0]}'{nearest(args[0], list(VERBS))}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """As of Click; a typo in an option or in one of a few words gets the nearest that there is."""
        try:
            return super().invoke(ctx)
        except typer.TyperException as error:
            if near := vars(error).get("possibilities"):
                vars(error)["possibilities"] = ()
                error.message += f"; did you mean `{near[0]}`?"
            if found := re.fullmatch(r"Value error, '(.*)' is not one of (.*)\.", error.message, re.DOTALL):
                choices = re.findall("'([^']*)'", found[2])
                error.message = f"'{found[1]}' is not valid{nearest(found[1], choices)}"
            raise

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """As of Click, by groups, from what is known without loading a verb."""
        formatter.write_paragraph()
        for group, verbs in GROUPS.items():
            formatter.write_heading(group)
            with formatter.indentation():
                formatter.write_dl([(f"{name:9}", text) for name, (_, text) in verbs.items()])


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
    """Posed camera frames in, live semantic 3D map out. Begin with `demo`.

    Exit codes: 0 done (`up`: also after Ctrl-C), 1 failed, 2 wrong usage or settings, 3 a map that cannot be trusted,
    4 an empty map, 130 Ctrl-C.
    """
    Settings.verbose = verbose


def main() -> None:
    """Entry point of the command."""
    if os.environ.get("_SEMANTIC_MAPPER_COMPLETE") == "complete_bash":
        _complete_in_bash()
    app(prog_name=app.info.name)


def _complete_in_bash() -> None:
    """Bash takes NAME=VALUE for three words, and completes the last: Typer gets one, and bash what follows the sign."""
    words: list[str] = []
    for word in os.environ["COMP_WORDS"].split("\n")[: int(os.environ["COMP_CWORD"]) + 1]:
        if words and (word in _SIGNS or words[-1][-1:] in _SIGNS):
            words[-1] += word
        else:
            words.append(word)
    os.environ.update(COMP_WORDS="\n".join(words), COMP_CWORD=str(len(words) - 1))
    with suppress(SystemExit), redirect_stdout(io.StringIO()) as found:
        app(prog_name=app.info.name)
    before = re.sub(r"[^=:]*$", "", words[-1])
    for line in found.getvalue().splitlines():
        typer.echo(line.removeprefix(before))
    sys.exit()
