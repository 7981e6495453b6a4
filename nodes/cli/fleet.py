"""``semantic-mapper fleet``: many logs, many machines, one store of results."""

from __future__ import annotations

import typer

from semantic_mapper.nodes.cli import fleet_merge, fleet_results, fleet_run

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Replay, score, label, finetune and merge many logs, on this machine or a Ray cluster.",
)

for _function in (
    fleet_run.run,
    fleet_run.top,
    fleet_merge.merge,
    fleet_results.table,
    fleet_results.report,
    fleet_results.compare,
):
    app.command(_function.__name__)(_function)
