"""The command ``semantic-mapper``. Each verb lives in a file of its own and imports what is heavy when it runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, cast

import typer
from typer.core import TyperGroup

from semantic_mapper import __version__
from semantic_mapper.nodes.cli import autolabel as cli_autolabel
from semantic_mapper.nodes.cli import bench as cli_bench
from semantic_mapper.nodes.cli import boxes as cli_boxes
from semantic_mapper.nodes.cli import calibrate as cli_calibrate
from semantic_mapper.nodes.cli import cameras as cli_cameras
from semantic_mapper.nodes.cli import compare as cli_compare
from semantic_mapper.nodes.cli import correct as cli_correct
from semantic_mapper.nodes.cli import demo as cli_demo
from semantic_mapper.nodes.cli import doctor as cli_doctor
from semantic_mapper.nodes.cli import eval as cli_eval
from semantic_mapper.nodes.cli import export as cli_export
from semantic_mapper.nodes.cli import finetune as cli_finetune
from semantic_mapper.nodes.cli import fleet as cli_fleet
from semantic_mapper.nodes.cli import keys as cli_keys
from semantic_mapper.nodes.cli import label as cli_label
from semantic_mapper.nodes.cli import launch as cli_launch
from semantic_mapper.nodes.cli import log as cli_log
from semantic_mapper.nodes.cli import map as cli_map
from semantic_mapper.nodes.cli import query as cli_query
from semantic_mapper.nodes.cli import record as cli_record
from semantic_mapper.nodes.cli import refine as cli_refine
from semantic_mapper.nodes.cli import relocalize as cli_relocalize
from semantic_mapper.nodes.cli import replay as cli_replay
from semantic_mapper.nodes.cli import top as cli_top
from semantic_mapper.nodes.cli import up as cli_up
from semantic_mapper.nodes.cli import view as cli_view
from semantic_mapper.nodes.cli import weights as cli_weights
from semantic_mapper.nodes.cli.verb import Settings
from semantic_mapper.redaction import without_secrets

_UsageError = cast("type[Exception]", typer.BadParameter.__base__)  # Click's, or Typer's own copy of it


class _Group(TyperGroup):
    """Shows wrong usage without the secrets of what was typed."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """As of Click."""
        with _redacted():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """As of Click."""
        with _redacted():
            return super().invoke(ctx)


@contextmanager
def _redacted() -> Iterator[None]:
    try:
        yield
    except _UsageError as error:
        error.__dict__["message"] = without_secrets(str(error.__dict__["message"]))
        raise


app = typer.Typer(
    name="semantic-mapper",
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)

for _function in (
    cli_demo.demo,
    cli_map.map_,
    cli_replay.replay,
    cli_compare.compare,
    cli_up.up,
    cli_top.top,
    cli_view.view,
    cli_cameras.cameras,
    cli_record.record,
    cli_calibrate.calibrate,
    cli_log.import_,
    cli_log.info,
    cli_log.recover,
    cli_export.export,
    cli_export.merge,
    cli_relocalize.relocalize,
    cli_refine.refine,
    cli_finetune.finetune,
    cli_autolabel.autolabel,
    cli_correct.correct,
    cli_label.label,
    cli_weights.weights,
    cli_doctor.doctor,
):
    app.command(_function.__name__.rstrip("_"))(_function)

app.add_typer(cli_fleet.app, name="fleet")
app.add_typer(cli_keys.app, name="keys")
app.add_typer(cli_launch.app, name="launch")

app.command("eval")(cli_eval.evaluate)
# Coordinates below 0 look like options.
app.command("query", context_settings={"ignore_unknown_options": True})(cli_query.query)
app.command("boxes")(cli_boxes.boxes)
app.command("bench")(cli_bench.bench)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"semantic-mapper {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Tell more, and show where an error arose.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Posed camera frames in, live semantic 3D map out.

    Start with `semantic-mapper demo`. Each verb explains itself: `semantic-mapper replay --help`. Results go to
    stdout, messages to stderr. Exit codes: 0 done (`up`: also after Ctrl-C), 1 failed, 2 wrong usage, 3 a map that
    cannot be trusted (`map`, `replay`), 130 Ctrl-C.
    """
    Settings.verbose = verbose


def main() -> None:
    """Entry point of the command."""
    app()
