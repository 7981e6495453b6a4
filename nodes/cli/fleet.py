"""``semantic-mapper fleet``: many logs, many machines, one store of results."""

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import typer
from rich.table import Table

from semantic_mapper.config import AtLeastZero, MapperConfig
from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.cli.verb import EXIT_FAILED, JsonOutput, Settings, complete, set_option, verb, wrong_usage
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.console import table as make_table
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.fleet.results import FleetComparison, LogChange, Rows, Tables, compare_stores
from semantic_mapper.nodes.fleet.store import Store, find_inputs
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted, without_secrets
from semantic_mapper.setting_docs import settings_of

MAX_SHOWN = 500  # rows that are printed
MAX_LOGS = 40
Operation = Literal["map", "eval", "autolabel", "finetune"]

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Map, score, label and finetune many logs. On this machine, or a Ray cluster (docs/fleet.md).",
)


def _settings(ctx: typer.Context, incomplete: str) -> list[str]:
    from semantic_mapper.nodes.fleet.run import OPERATIONS

    kind = OPERATIONS.get("".join(ctx.args[:1]))
    return complete(settings_of(kind.settings), incomplete) if kind else []


@app.command()
@verb
def run(
    output: JsonOutput,
    operation: Operation,  # as the verb
    # paths, URLs (s3, gs, http), globs in quotes, or manifests (CSV with a column `log`; others are tags)
    logs: list[str],
    *,
    out: str,  # folder or URL for the results
    weights: str | None = None,  # file, URL, or name of weights in the package; without it those of the verb
    settings: Annotated[list[str] | None, set_option(_settings)] = None,
    config: Path | None = None,  # TOML file with settings; --set goes before it
    address: str | None = None,  # HOST:PORT of a Ray cluster to join; without it Ray starts here, on loopback only
    cpus: Annotated[float, msgspec.Meta(ge=0.1)] = 1.0,  # CPUs of a task
    gpus: AtLeastZero = 0.0,  # GPUs of a task; views are rendered there then
    memory: Annotated[float, msgspec.Meta(ge=0.1)] | None = None,  # GB of a task; without it 2, finetune 4
) -> int:
    """Do an operation with many logs, once each, and keep the results in a store.

    A result is named by the content of the log, the weights, the settings and the code: what is in the store is not
    done again, so that the same command continues a run that was stopped or killed, and tries failed logs again. The
    exit code is 1 where logs failed. Ctrl-C ends the tasks that run (exit code 130).

    Example: semantic-mapper fleet run map "logs/*.mcap" --out runs/fleet
    Example: semantic-mapper fleet run eval robots.csv --out s3://maps/week
    Example: semantic-mapper fleet run map logs --out runs/a --set quality=fast
    """
    inputs = find_inputs(logs)  # before what is heavy
    from semantic_mapper.nodes.fleet.run import OPERATIONS, make_task, run_fleet

    kind = OPERATIONS[operation]
    on_gpu = ["render.device=cuda"] if gpus and issubclass(kind.settings, MapperConfig) else []
    with wrong_usage():
        task = make_task(operation, out, weights, [*on_gpu, *(settings or ())], config)
    with (
        StopRequest() as stop,
        connected(address, worker_logs=Settings.verbose),
        frame_progress(f"fleet {operation}", len(inputs), unit="logs") as bar,
    ):
        report = run_fleet(
            task,
            inputs,
            cpus=cpus,
            gpus=gpus,
            memory_gb=memory or kind.memory_gb,
            stopped=lambda: stop,
            on_progress=lambda now: bar.set(now.over),
        )
    shown, failures = without_secrets(out), report.failures
    counts = f"{report.done} done, {report.existing} were there, {len(failures)} failed, of {report.total}"
    output.print(f"{shown}: {counts}")
    for failure in failures[:MAX_LOGS]:
        output.print(f"  failed: {failure.log}: {failure.error}")
    output.json({"store": shown, **msgspec.to_builtins(report)})
    if stop:
        stderr_console().print(f"stopped by {stop.name}; the same command continues it", style="yellow")
        return stop.exit_code
    return EXIT_FAILED if failures else 0


@app.command()
@verb
def table(
    output: JsonOutput,
    store: str,  # path or URL of a store, as `fleet run --out` has written it
    query: str
    | None = None,  # columns of `logs`, such as "log, miou", or a SELECT on logs, classes, events and failures
) -> None:
    """Query the results of a fleet with SQL (DuckDB); without a query, show an overview and the columns.

    `logs` has a row for each result: metrics such as `miou`, costs as `cost_NAME`, tags as `tag_NAME`. `classes` and
    `events` belong to a row of `logs` by `key`; `failures` has a row for each log that failed.

    Example: semantic-mapper fleet table runs/fleet
    Example: semantic-mapper fleet table runs/fleet "log, miou" --json
    Example: semantic-mapper fleet table runs/fleet "SELECT * FROM failures"
    """
    tables = Tables(Store(store))
    rows = tables.overview() if query is None else tables.query(query)
    plain: Any = [dict(zip(rows.names, row, strict=True)) for row in rows.values]
    output.print(_shown(rows))
    if len(rows.values) > MAX_SHOWN:
        output.print(f"{len(rows.values) - MAX_SHOWN} more rows; --json gives all")
    if query is None:
        plain = {"overview": plain, "columns": tables.columns()}
        for name, columns in tables.columns().items():
            output.print(f"{name}: {', '.join(columns)}")
    output.json(plain)


@app.command()
@verb
def compare(
    output: JsonOutput,
    store_a: str,  # path or URL of the store with results before
    store_b: str,  # of that with results after
    *,
    operation: Operation | None = None,  # not needed where A has results of one only
    metric: str = "miou",  # miou, "miou METHOD", iou:CLASS, or another metric or cost
    threshold: AtLeastZero = 0.0,  # allowed loss of the mean over logs, in units of the metric
    log_threshold: AtLeastZero = 0.05,  # allowed loss of the score of a single log
) -> int:
    """Say which logs of a fleet got better or worse, beyond noise: a gate for releases.

    The latest results of each log are paired by its content. B is worse where the mean over logs is
    significantly worse, where single logs are worse by more than --log-threshold, or where logs with a result in A
    failed in B, are missing there or have no score. Exit codes: 0 not worse, 1 worse, 2 wrong usage, or something that
    cannot be read.

    Example: semantic-mapper fleet compare runs/released runs/candidate
    Example: semantic-mapper fleet compare runs/a runs/b --metric iou:person
    Example: semantic-mapper fleet compare runs/a runs/b --metric step_ms_p50
    """
    limits = {"threshold": threshold, "log_threshold": log_threshold}
    with wrong_usage(SemanticMapperError):
        found = compare_stores(Store(store_a), Store(store_b), operation or "", metric, **limits)
    output.json({"worse": bool(found.reasons), **msgspec.to_builtins(found)})
    _show_comparison(output, found)
    return EXIT_FAILED if found.reasons else 0


def _shown(rows: Rows) -> Table:
    """Rows for people; columns of numbers end at the right."""
    values = rows.values[:MAX_SHOWN]
    numeric = [all(isinstance(value, int | float | None) for value in column) for column in zip(*values, strict=True)]
    numbers = [name for name, is_numeric in zip(rows.names, numeric, strict=False) if is_numeric]
    return make_table([[_cell(value) for value in row] for row in values], rows.names, numbers=numbers)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 10_000 else f"{value:.0f}"
    return "-" if value is None else str(value)


def _show_comparison(output: Output, found: FleetComparison) -> None:
    direction = "lower" if found.lower_is_better else "higher"
    changed = [log for log in found.logs if log.status != "same"]
    rows: list[tuple[Any, ...]] = []
    for change in changed[:MAX_LOGS]:
        rows.append((change.log, change.a, change.b, _difference(change), f"{change.status} {change.reason}".strip()))
    interval = "" if found.interval is None else "95 % interval {:+.4f} to {:+.4f}".format(*found.interval)
    rows.append(("mean over logs", found.a, found.b, _difference(found), interval))
    names = ("log", "A", "B", "difference", "")
    output.print(f"{found.operation}, {found.metric} ({direction} is better)", _shown(Rows(names, rows)))
    counts = ", ".join(f"{counted(found.count(status), 'log')} {status}" for status in ("worse", "better", "same"))
    output.print(f"{counts}; --json gives all")
    output.print(f"worse: {'; '.join(found.reasons)}" if found.reasons else "not worse")


def _difference(change: LogChange | FleetComparison) -> str:
    return "-" if change.a is None or change.b is None else f"{change.b - change.a:+.4f}"
