"""The command ``semantic-mapper-research``: train fields, run the suites, measure."""

from __future__ import annotations

import typer

from research.cli import bench, benchmark, train

app = typer.Typer(
    name="semantic-mapper-research",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
app.command("train")(train.train)
app.command("suite")(benchmark.benchmark)
app.add_typer(bench.app, name="bench")


@app.callback()
def _options() -> None:
    """Rendered scenes, peers, trainers and suites behind semantic-mapper."""


def main() -> None:
    """Entry point of the command."""
    app()
