"""What all verbs of the command line share: process set-up, groups of options, one clear line for an error, exit codes.

0 done; 1 failed; 2 wrong usage; 3 a map that cannot be trusted; 130 after Ctrl-C, 143 after SIGTERM (what was done so
far is written where a verb says so); 1 too where a result is negative (``doctor`` finds something missing).
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import structlog
import typer
from rich.text import Text
from typer.core import TyperCommand, TyperOption

from semantic_mapper.errors import LogError, SemanticMapperError
from semantic_mapper.nodes.cli.options import OptionGroup
from semantic_mapper.nodes.console import stderr_console
from semantic_mapper.nodes.failures import failure_message
from semantic_mapper.nodes.process import prepare_process
from semantic_mapper.plain_text import visible, without_secrets

EXIT_FAILED = 1
EXIT_UNTRUSTED = 3  # poses and depth of a recording contradict each other, so that its map cannot be trusted
EXIT_INTERRUPTED = 130
MAX_OPTION = 1e6  # of lengths, times and sizes; that many seconds are eleven days
MIN_OPTION = 1e-9  # of the same, but for 0: one divided by it must be a number

_log = structlog.get_logger(__name__)

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")]


class Settings:
    """Options that stand before the verb."""

    verbose = False


class VerbCommand(TyperCommand):
    """A command whose rare options are hidden: ``--help-all`` shows them, too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As of Click."""
        if "--help-all" in args:
            for parameter in self.params:
                if isinstance(parameter, TyperOption):
                    parameter.hidden = False
            args = ["--help"]
        return super().parse_args(ctx, args)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Says that there are more options."""
        if any(getattr(parameter, "hidden", False) for parameter in self.params):
            formatter.write_paragraph()
            formatter.write_text("--help-all shows more options.")


def verb(function: Callable[..., int | None]) -> Callable[..., None]:
    """Make a command of a function that returns an exit code (None = 0) and raises ``SemanticMapperError``.

    A parameter whose type is an ``OptionGroup`` stands for the options of the group.
    """
    signature = inspect.signature(function, eval_str=True)
    groups: dict[str, tuple[type[OptionGroup], list[str]]] = {}
    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        if isinstance(parameter.annotation, type) and issubclass(parameter.annotation, OptionGroup):
            options = parameter.annotation.parameters()
            groups[parameter.name] = parameter.annotation, [option.name for option in options]
            parameters += options
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(function)
    def command(**kwargs: Any) -> None:
        prepare_process(verbose=Settings.verbose)
        _check_values(kwargs)
        try:
            for name, (group, options) in groups.items():
                kwargs[name] = group(**{option: kwargs.pop(option) for option in options})
            code = function(**kwargs)
        except SemanticMapperError as error:
            if Settings.verbose:
                _log.exception("failed", error=str(error))
            show_error(str(error))
            code = EXIT_FAILED
        except KeyboardInterrupt:
            show_error("interrupted")
            code = EXIT_INTERRUPTED
        except BrokenPipeError:  # the reader of our stdout is gone (`... | head`): nothing is left to be said
            code = EXIT_FAILED
        except Exception as error:
            if not (message := failure_message(error)):
                raise
            if Settings.verbose:
                _log.exception("failed")
            show_error(message)
            code = EXIT_FAILED
        sys.stderr.flush()
        raise typer.Exit(code or 0)

    command.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportAttributeAccessIssue]
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    # Click joins the lines of a paragraph but for those after a backspace: an example is there to be copied.
    command.__doc__ = inspect.cleandoc(function.__doc__ or "").replace("\n\nExample:", "\n\n\b\nExample:", 1)
    return command


def results_file(out: Path | None) -> Path | None:
    """The file that ``--out`` names.

    Raises:
        typer.BadParameter: the file is there and is no JSON, such as weights that were named by mistake.
    """
    if out is not None and out.is_file() and out.suffix != ".json":
        raise typer.BadParameter(f"{out} is there and does not end in .json; results would replace it")
    return out


def must_be_there(*paths: Path) -> None:
    """Refuse what is missing at once, before the packages that read it are loaded.

    Raises:
        LogError: one of them is missing, or neither a file nor a folder.
    """
    for path in paths:
        if not path.exists():
            raise LogError(f"{path}: cannot be read: no such file or folder")
        if not path.is_file() and not path.is_dir():
            raise LogError(f"{path}: cannot be read: it is no regular file; copy its content to one")


def _check_values(options: Mapping[str, object]) -> None:
    """Options know lower bounds only, and NaN passes these; programs that call a verb may name anything.

    Raises:
        typer.BadParameter: a number that nothing can be computed with, or a NUL character.
    """
    for name, value in options.items():
        hint = f"--{name.replace('_', '-')}"
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, float) and not -MAX_OPTION <= item <= MAX_OPTION:
                raise typer.BadParameter(f"{item:g}: give a number of at most {MAX_OPTION:g}", param_hint=hint)
            if isinstance(item, float) and 0 < abs(item) < MIN_OPTION:
                raise typer.BadParameter(f"{item:g}: give 0, or at least {MIN_OPTION:g}", param_hint=hint)
            if isinstance(item, str | Path) and "\0" in str(item):
                raise typer.BadParameter("holds a NUL character, which no name may", param_hint=hint)


def show_error(message: str) -> None:
    """One red line on stderr."""
    message = without_secrets(" ".join(message.split("\n")))
    line = Text.assemble(("error: ", "bold red"), (visible(message), "red"))
    stderr_console().print(line, soft_wrap=True)
