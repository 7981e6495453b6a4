"""``semantic-mapper fleet table``, ``report`` and ``compare``: what a fleet has found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.nodes.cli.verb import show_error, verb
from semantic_mapper.nodes.console import Output

if TYPE_CHECKING:
    import pyarrow as pa
    from rich.table import Table

    from semantic_mapper.nodes.fleet.compare import Estimate, FleetComparison, LogChange
    from semantic_mapper.nodes.fleet.tables import Tables

EXIT_WORSE = 1
EXIT_TROUBLE = 2
MAX_ROWS = 500  # that are printed
MAX_LOGS = 40

StoreArgument = Annotated[
    str, typer.Argument(metavar="STORE", help="Path or URL of a store, as `fleet run --out` has written it.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")]


@verb
def table(
    store: StoreArgument,
    sql: Annotated[
        str | None,
        typer.Argument(metavar="SQL", help="A SELECT on logs, classes, events, segments and failures, for DuckDB."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all rows here, as CSV.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all rows here, as Parquet.")] = None,
    json: JsonOption = False,
) -> None:
    """Query the results of a fleet with SQL; without it, show an overview and the columns that there are.

    `logs` has a row for each log and way of running it: metrics such as `miou`, costs as `cost_NAME`, tags as
    `tag_NAME`. `classes`, `events` and `segments` belong to a row of `logs` by `key`; `failures` has a row for each log
    that was given up.

    Example: semantic-mapper fleet table runs/fleet
    Example: semantic-mapper fleet table runs/fleet "SELECT log, miou FROM logs WHERE tag_robot = 'r2' ORDER BY miou"
    Example: semantic-mapper fleet table s3://bucket/fleet "SELECT * FROM events" --csv events.csv
    """
    if sql is None and (csv or out):
        raise typer.BadParameter("is needed with --csv and --out", param_hint="SQL")
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.nodes.fleet.store import Store
    from semantic_mapper.nodes.fleet.tables import Tables, plain_rows, query

    opened = Store(store)
    if sql is None:
        with Tables(opened) as tables:
            _overview(output, tables, as_json=json)
        return
    found = query(opened, sql)
    for path, write in ((csv, _write_csv), (out, _write_parquet)):
        if path is not None:
            _write_file(path, found, write)
            output.print(f"{found.num_rows} rows written to {path}")
    if json:
        output.json(plain_rows(found))
    elif not csv and not out:
        output.print(rows_table(found.column_names, plain_rows(found.slice(0, MAX_ROWS))))
        if found.num_rows > MAX_ROWS:
            output.print(f"{found.num_rows - MAX_ROWS} more rows; --csv, --out and --json give all")


@verb
def report(
    store: StoreArgument,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for report.html.  [default: STORE/report, or runs/fleet-report]"),
    ] = None,
) -> None:
    """Write the results of a fleet as one page of HTML.

    Distributions, classes, the worst logs with their pictures and reports, events, logs that were given up, trend over
    versions, and differences by tag. The page fetches nothing; its links lead to the report of each log.

    Example: semantic-mapper fleet report runs/fleet
    Example: semantic-mapper fleet report s3://bucket/fleet --out runs/fleet-report
    """
    output = Output.guarded()
    from semantic_mapper.nodes.cli.fleet_report import write_fleet_report
    from semantic_mapper.nodes.fleet.store import Store

    output.print(f"written to {write_fleet_report(Store(store), out)}")


@verb
def compare(
    store_a: Annotated[str, typer.Argument(metavar="STORE_A", help="Path or URL of the store with results before.")],
    store_b: Annotated[
        str | None, typer.Argument(metavar="STORE_B", help="Of that with results after.  [default: STORE_A]")
    ] = None,
    a: Annotated[
        list[str] | None,
        typer.Option(
            "--a",
            metavar="NAME=VALUE",
            help="Which results of STORE_A: version, weights, code or a setting of --set. May be repeated.  [default: "
            "the latest]",
        ),
    ] = None,
    b: Annotated[
        list[str] | None, typer.Option("--b", metavar="NAME=VALUE", help="The same for STORE_B. May be repeated.")
    ] = None,
    operation: Annotated[
        str, typer.Option(metavar="NAME", help="replay, eval, ...; not needed where both stores share only one.")
    ] = "",
    metric: Annotated[
        str, typer.Option(metavar="NAME", help="miou, iou:CLASS, or any other metric of the results.")
    ] = "miou",
    method: Annotated[
        str, typer.Option(metavar="NAME", help="eval: whose labels count, such as sray.  [default: that of miou]")
    ] = "",
    threshold: Annotated[
        float, typer.Option(min=0, help="Allowed loss of the mean over logs, in units of the metric.")
    ] = 0.0,
    log_threshold: Annotated[float, typer.Option(min=0, help="Allowed loss of a single log.")] = 0.02,
    lower_is_better: Annotated[
        bool | None,
        typer.Option("--lower-is-better/--higher-is-better", help="Of the metric.  [default: as declared for it]"),
    ] = None,
    cost: Annotated[
        list[str] | None,
        typer.Option(
            "--cost",
            metavar="NAME=FRACTION",
            help="Also stop where this cost has risen by more, such as step_ms_p50=0.1. May be repeated.",
        ),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Say which logs of a fleet got better or worse, beyond noise: a gate for releases.

    Results are paired by the content of their logs. B is worse where the mean over logs has surely fallen below that of
    A, where single logs have surely lost more than --log-threshold, or where logs with a result in A failed in B, are
    missing there or have no score, also where B has no result at all. Of several versions, weights or settings in a
    store, the latest count; --a and --b choose others. Exit codes: 0 not worse, 1 worse, 2 wrong usage, or something
    that cannot be read.

    Example: semantic-mapper fleet compare runs/released runs/candidate
    Example: semantic-mapper fleet compare runs/fleet --a version=0.1.0 --b version=0.2.0 --cost step_ms_p50=0.1
    Example: semantic-mapper fleet compare runs/released runs/candidate --metric iou:person --log-threshold 0.05 --json
    """
    if store_b is None and not (a or b):
        raise typer.BadParameter("give one, or --a and --b to compare results of one store", param_hint="STORE_B")
    output = Output.guarded()
    output.quiet = json
    from semantic_mapper.nodes.fleet.compare import GateOptions, compare_fleets
    from semantic_mapper.nodes.fleet.store import Store

    try:
        options = GateOptions(
            operation=operation,
            metric=metric,
            method=method,
            a=_pairs("--a", a),
            b=_pairs("--b", b),
            threshold=threshold,
            log_threshold=log_threshold,
            lower_is_better=lower_is_better,
            costs={name: _fraction(name, value) for name, value in _pairs("--cost", cost).items()},
        )
        first = Store(store_a)
        found = compare_fleets(first, first if store_b is None else Store(store_b), options)
    except SemanticMapperError as error:
        show_error(str(error))
        return EXIT_TROUBLE
    if json:
        output.json(found.to_plain())
    _show_comparison(output, found)
    return EXIT_WORSE if found.worse else 0


# Tables


def rows_table(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> Table:
    """Rows for people; columns of numbers end at the right."""
    from rich.table import Table

    rows = list(rows)
    table = Table()
    for name in names:
        numbers = all(isinstance(row[name], (int, float)) for row in rows if row[name] is not None)
        table.add_column(name, justify="right" if rows and numbers else "left")
    for row in rows:
        table.add_row(*(cell_text(row[name]) for name in names))
    return table


def cell_text(value: Any) -> str:
    """A value of a table, short."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 10_000 else f"{value:.0f}"
    return str(value)


def _overview(output: Output, tables: Tables, *, as_json: bool) -> None:
    from semantic_mapper.nodes.fleet.tables import plain_rows
    from semantic_mapper.nodes.fleet.variants import DEFAULT_WEIGHTS, quoted

    there = tables.columns()
    scored = any(name == "miou" for name, _ in there["logs"])
    figures = "round(median(miou), 4) AS miou_median, round(min(miou), 4) AS miou_worst, " if scored else ""
    found = tables.query(
        f"""
        SELECT operation, version, coalesce(nullif(weights, ''), {quoted(DEFAULT_WEIGHTS)}) AS weights, settings,
            count(*) AS logs, {figures}
            round(median(seconds), 1) AS seconds_median, max(finished) AS finished
        FROM logs GROUP BY ALL ORDER BY operation, finished
        """,
    )
    given_up = tables.query(
        """
        SELECT operation, version, count(*) AS given_up, arg_max(error, finished) AS latest_error
        FROM failures GROUP BY ALL ORDER BY operation, version
        """,
    )
    if as_json:
        rows = {"overview": plain_rows(found), "failures": plain_rows(given_up)}
        output.json({**rows, "columns": {view: dict(pairs) for view, pairs in there.items()}})
        return
    output.print(rows_table(found.column_names, plain_rows(found)))
    if given_up.num_rows:
        output.print(rows_table(given_up.column_names, plain_rows(given_up)))
    for view, pairs in there.items():
        output.print(f"{view}: {', '.join(name for name, _ in pairs)}")


def _write_file(path: Path, found: pa.Table, write: Any) -> None:
    import io

    from semantic_mapper.files import write_bytes
    from semantic_mapper.replay.run_folder import prepare_file

    prepare_file(path)
    stream = io.BytesIO()
    write(stream, found)
    try:
        write_bytes(path, stream.getvalue())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error


def _write_parquet(stream: Any, found: pa.Table) -> None:
    import pyarrow.parquet as pq

    pq.write_table(found, stream)


def _write_csv(stream: Any, found: pa.Table) -> None:
    """Lists as JSON; an empty cell is no value."""
    import csv
    import io
    import json

    from semantic_mapper.nodes.fleet.tables import plain_rows

    text = io.TextIOWrapper(stream, encoding="utf-8", newline="", write_through=True)
    writer = csv.writer(text)
    writer.writerow(found.column_names)
    for batch in found.to_batches(max_chunksize=10_000):
        for row in plain_rows(batch):
            writer.writerow([json.dumps(v) if isinstance(v, (list, dict)) else v for v in row.values()])
    text.detach()


# Comparison


def _pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """NAME=VALUE.

    Raises:
        ConfigError: one of them is written otherwise.
    """
    found = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise ConfigError(f"{option} {text}: write NAME=VALUE")
        found[name] = value
    return found


def _fraction(name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = -1.0
    if not 0 <= number < 1000:
        raise ConfigError(f"--cost {name}={value}: write a fraction, such as {name}=0.1 for 10 %")
    return number


def _show_comparison(output: Output, found: FleetComparison) -> None:
    from rich.table import Table

    for line in (f"A {found.a}", f"B {found.b}"):
        output.print(line)
    table = Table(title=f"{found.operation}, {found.metric} ({found.direction})", title_justify="left")
    table.add_column("log")
    for name in ("A", "B", "difference", "95 % interval"):
        table.add_column(name, justify="right")
    table.add_column("")
    shown = [log for log in found.logs if log.status != "same"][:MAX_LOGS] or list(found.logs[:5])
    for log in shown:
        bad = log.status not in ("same", "better")
        table.add_row(log.log, *_change_cells(log), style="red" if bad else "")
    output.print(table)
    if len(found.logs) > len(shown):
        output.print(f"{len(found.logs) - len(shown)} more logs; --json gives all")
    if found.costs:
        output.print(cost_table(found))
    for note in found.notes:
        output.print(f"note: {note}")
    if found.new:
        output.print(f"note: {len(found.new)} logs are in B only, such as {found.new[0]}")
    for line in summary_lines(found):
        output.print(line)


def _change_cells(log: LogChange) -> tuple[str, str, str, str, str]:
    a, b = (cell_text(value) for value in (log.a, log.b))
    difference = "-" if log.a is None or log.b is None else f"{log.b - log.a:+.4f}"
    status = "" if log.status == "same" else log.status
    return a, b, difference, _interval(log.estimate), f"{status}: {log.reason}" if log.reason else status


def _interval(estimate: Estimate | None) -> str:
    return "-" if estimate is None else f"{estimate.low:+.4f} .. {estimate.high:+.4f}"


def cost_table(found: FleetComparison) -> Table:
    """Costs of A and B; those beyond their limit are red."""
    from rich.table import Table

    table = Table(title="costs, median over logs", title_justify="left")
    table.add_column("cost")
    for name in ("A", "B", "change", "95 % interval", "allowed"):
        table.add_column(name, justify="right")
    for cost in found.costs:
        known = cost.low == cost.low  # no NaN
        interval = f"{100 * (cost.low - 1):+.1f} .. {100 * (cost.high - 1):+.1f} %" if known else "-"
        allowed = "" if cost.limit is None else f"{100 * cost.limit:+g} %"
        cells = cell_text(cost.a), cell_text(cost.b), f"{100 * (cost.ratio - 1):+.1f} %", interval, allowed
        table.add_row(cost.name, *cells, style="red" if cost.exceeded else "")
    return table


def summary_lines(found: FleetComparison) -> list[str]:
    """The fleet as a whole, and the result."""
    lines = []
    if found.mean_a == found.mean_a:  # no NaN
        scored = sum(log.a is not None and log.b is not None for log in found.logs)
        interval = "" if found.overall is None else f", 95 % interval {_interval(found.overall)}"
        change = found.mean_b - found.mean_a
        lines.append(
            f"mean of {scored} logs: A {found.mean_a:.4f}, B {found.mean_b:.4f}, difference {change:+.4f}{interval}; "
            f"{found.count('worse')} logs worse, {found.count('better')} better"
        )
    lines.append(f"worse: {'; '.join(found.reasons)}" if found.worse else "not worse")
    return lines
