"""``semantic-mapper fleet``: operations over many logs, and their results."""

from __future__ import annotations

import typer

from semantic_mapper.nodes.cli import fleet_results

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Operations over many logs, and their results.")

app.command("table")(fleet_results.table)
app.command("report")(fleet_results.report)
app.command("compare")(fleet_results.compare)
