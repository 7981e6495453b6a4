"""Results of a store: as tables for SQL, and compared with those of another store, a gate for releases."""

import math
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import scipy  # loads `stats` when it is first used

from semantic_mapper.config import nearest
from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.store import Store, TaskResult, fleet_package
from semantic_mapper.plain_text import counted

_SQL = re.compile(r"\W*(select|with|from|pivot|unpivot|describe|summarize|show|values)\b", re.IGNORECASE)
_LOG_TEXTS = ("key", "operation", "log", "log_digest", "weights", "settings", "version", "node", "folder")
_COLUMNS = {
    "logs": {**dict.fromkeys(_LOG_TEXTS, "VARCHAR"), "seconds": "DOUBLE", "finished": "TIMESTAMP"},
    "classes": {**dict.fromkeys(("key", "method", "name"), "VARCHAR"), "iou": "DOUBLE"},
    "events": dict.fromkeys(("key", "kind", "text"), "VARCHAR"),
    "failures": {**dict.fromkeys(("operation", "log", "tags", "version", "error"), "VARCHAR"), "finished": "TIMESTAMP"},
}


class Rows(msgspec.Struct, frozen=True):
    """Rows of a query: names of their columns, and values that JSON has."""

    names: tuple[str, ...]
    values: list[tuple[Any, ...]]


class Tables:
    """The results of a store as they are now, in an in-memory database of DuckDB.

    ``logs`` has a row for each result: each metric by its name, each cost as ``cost_NAME``, each tag as ``tag_NAME``;
    what only other results have is NULL. ``classes`` and ``events`` belong to it by ``key``. ``failures`` has a row for
    each log that failed and was not done since.

    Raises ConfigError: a document is damaged. StoreError: the store cannot be reached. DependencyError: DuckDB is
    missing.
    """

    def __init__(self, store: Store) -> None:
        duckdb = fleet_package("duckdb")
        self._error = duckdb.Error
        self._database = duckdb.connect()
        kinds = {table: dict(columns) for table, columns in _COLUMNS.items()}
        with tempfile.TemporaryDirectory(prefix="semantic-mapper-fleet-") as folder:
            lines: dict[str, list[bytes]] = {table: [] for table in kinds}
            for table, row in _rows(store):
                for name, value in row.items():
                    kinds[table].setdefault(name, "VARCHAR" if isinstance(value, str) else "DOUBLE")
                lines[table].append(msgspec.json.encode(row))
            for table, columns in kinds.items():
                file = Path(folder, f"{table}.json")
                file.write_bytes(b"\n".join(lines[table]))
                typed = ", ".join(f"{name}: '{kind}'" for name, kind in columns.items())
                source = f"'{file}', format = 'newline_delimited', columns = {{{typed}}}"
                self._database.execute(f"CREATE TABLE {table} AS SELECT * FROM read_json({source})")
        self._database.execute("SET enable_external_access = false; SET lock_configuration = true")

    def query(self, text: str) -> Rows:
        """The rows that a query selects; it can read and write nothing but these tables.

        Raises ConfigError: DuckDB refuses it, in its words.

        ``text`` is a statement of SQL in DuckDB's dialect, or names of columns of ``logs``, such as ``log, miou``.
        """
        try:
            found = self._database.execute(text if _SQL.match(text) else f"SELECT {text} FROM logs")
            names = tuple(column[0] for column in found.description or ())
            return Rows(names, [tuple(map(_plain, row)) for row in found.fetchall()])
        except self._error as error:
            raise ConfigError(f"SQL: {error}") from error

    def columns(self) -> dict[str, tuple[str, ...]]:
        """Names of the columns by table."""
        return {table: self.query(f"SELECT * FROM {table} LIMIT 0").names for table in _COLUMNS}

    def overview(self) -> Rows:
        """A row for each operation, version, weights and settings, the latest last."""
        figures = "round(median(miou), 4) AS miou_median," if "miou" in self.columns()["logs"] else ""
        return self.query(
            f"""
            SELECT operation, version, coalesce(nullif(weights, ''), 'default') AS weights, settings,
                count(*) AS logs, {figures} round(median(seconds), 1) AS seconds_median, max(finished) AS finished
            FROM logs GROUP BY ALL ORDER BY operation, finished
            """
        )


def _rows(store: Store) -> Iterator[tuple[str, dict[str, Any]]]:
    for result in store.results():
        key, found = result.key, result.findings
        named = [("", found.metrics), ("cost_", found.costs), ("tag_", result.tags)]
        row = {_column(prefix + name): value for prefix, values in named for name, value in values.items()}
        row |= {name: getattr(result, name) for name in (*_LOG_TEXTS, "seconds")}
        yield "logs", {**row, "settings": _json(result.settings), "finished": _time(result.finished_ns)}
        for scores in found.scores:
            for name, iou in scores.iou.items():
                yield "classes", {"key": key, "method": scores.method, "name": name, "iou": iou}
        for kind, text in found.events:
            yield "events", {"key": key, "kind": kind, "text": text}
    for failure in store.failures():
        row = {name: getattr(failure, name) for name in ("operation", "log", "version", "error")}
        yield "failures", {**row, "tags": _json(failure.tags), "finished": _time(failure.finished_ns)}


def _column(name: str) -> str:
    return re.sub(r"\W", "_", name.strip().lower(), flags=re.ASCII)


def _time(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).replace(tzinfo=None).isoformat(" ")


def _json(data: Mapping[str, Any]) -> str:
    return msgspec.json.encode(data, order="sorted").decode()


def _plain(value: Any) -> Any:
    """A value of DuckDB as JSON has it; what is neither number nor text becomes text."""
    if isinstance(value, float | Decimal):
        return float(value) if math.isfinite(value) else None
    return value if isinstance(value, int | str | None) else str(value)


# Comparison: Student's paired t-test over logs, and a limit for each score of a log by itself.

_CONFIDENCE = 0.95  # of intervals; a fleet that is no worse is called worse in at most one of twenty comparisons

# Costs are better lower, too; all others are better higher.
_LOWER_IS_BETTER = {
    *("unknown", "depth_disagreement", "frames_dropped", "frames_refused", "frames_labels_refused", "ece"),
    *("frames_without_depth", "frames_left_out", "frames_excluded_from_scores", "frames_excluded", "frames_damaged"),
    *("unlabelled", "held_out_loss"),
}
# Of logs that have a score in A only, and those that are worse; the first ones are shown first.
_BAD = {"failed": "failed in B", "missing": "missing in B", "unscored": "without a score in B", "worse": "worse"}


class LogChange(msgspec.Struct, frozen=True):
    """One log in both results."""

    log: str  # its URL in A
    a: float | None  # the metric; None = no score
    b: float | None = None
    status: str = "same"  # "worse", "better", "same"; "failed", "missing", "unscored": has a score in A only
    reason: str = ""  # why it failed


class FleetComparison(msgspec.Struct, frozen=True):
    """All that ``compare_stores`` found."""

    operation: str
    metric: str
    lower_is_better: bool
    a: float | None  # mean over the logs that both have a score of; None = no such log
    b: float | None
    interval: tuple[float, float] | None  # of the mean difference B - A; None = fewer than two such logs
    logs: tuple[LogChange, ...]  # the worst first
    reasons: tuple[str, ...]  # why B is worse; empty = it is not

    def count(self, status: str) -> int:
        """How many logs have a status."""
        return sum(log.status == status for log in self.logs)


def compare_stores(
    store_a: Store,
    store_b: Store,
    operation: str = "",
    metric: str = "miou",
    *,
    threshold: float = 0.0,
    log_threshold: float = 0.05,
) -> FleetComparison:
    """Compare the latest results of the same logs, paired by the content of these.

    Logs of A that failed in B, or are missing there, count as worse, also where B has no result at all. Raises
    ConfigError: there is nothing to compare: no such operation or metric, or B has results of other logs only.
    StoreError: a store cannot be reached.

    Args:
        store_a: With the results before.
        store_b: With those after.
        operation: Empty = the only one that A has.
        metric: "miou", "miou METHOD", "iou:CLASS", another metric of the results, or a cost.
        threshold: B is worse where the interval of its mean lies below minus this, in units of the metric.
        log_threshold: A log is worse where its score has lost more than this; costs and counts of one log are noise.
    """
    results = list(store_a.results())
    operations = sorted({result.operation for result in results})
    operation = operation or (operations[0] if len(operations) == 1 else "")
    if operation not in operations:
        raise ConfigError(f"{store_a.shown}: name an operation of its results (--operation): {', '.join(operations)}")
    a, b = (_latest(found, operation) for found in (results, store_b.results()))
    if b and a.keys().isdisjoint(b):
        raise ConfigError(f"{store_a.shown} and {store_b.shown}: no log has results of `{operation}` in both")
    names = {name for result in a.values() for name, value in _values(result).items() if value is not None}
    if metric not in names:
        raise ConfigError(f"{store_a.shown}: no result has the metric {metric!r}{nearest(metric, sorted(names))}")
    costs = {"seconds", *(name for result in a.values() for name in result.findings.costs)}
    lower_is_better = metric in _LOWER_IS_BETTER or metric in costs
    sign = -1.0 if lower_is_better else 1.0
    errors = {failure.log: failure.error for failure in store_b.failures() if failure.operation == operation}
    limit = log_threshold if metric.startswith(("miou", "iou:")) else math.inf
    changes = [
        _change(result, b.get(digest), metric, errors, sign, limit)
        for digest, result in a.items()
        if digest not in b or _values(result).get(metric) is not None
    ]
    changes.sort(key=lambda change: _rank(change, sign))
    before, after = np.array([(c.a, c.b) for c in changes if c.b is not None], np.float64).reshape(-1, 2).T
    means = (float(before.mean()), float(after.mean())) if len(before) else (None, None)
    interval, gain = None, after - before
    if len(gain) > 1:
        reach = float(scipy.stats.t.ppf(0.5 + _CONFIDENCE / 2, len(gain) - 1) * scipy.stats.sem(gain))
        interval = float(gain.mean()) - reach, float(gain.mean()) + reach
    reasons: list[str] = []
    if interval is not None and max(sign * end for end in interval) < -threshold:
        limit_text = f" by more than {threshold:g}" if threshold else ""
        reasons.append(f"the mean of {metric} over logs is worse{limit_text}")
    for status, text in {**_BAD, "worse": f"worse by more than {log_threshold:g}"}.items():
        if count := sum(change.status == status for change in changes):
            reasons.append(f"{counted(count, 'log')} {text}")
    return FleetComparison(operation, metric, lower_is_better, *means, interval, tuple(changes), tuple(reasons))


def _latest(results: Iterator[TaskResult] | Sequence[TaskResult], operation: str) -> dict[str, TaskResult]:
    """By the digest of the log's content."""
    chosen = sorted((r for r in results if r.operation == operation), key=lambda r: r.finished_ns)
    return {result.log_digest: result for result in chosen}


def _values(result: TaskResult) -> dict[str, float | None]:
    found = result.findings
    classes = {f"iou:{name}": iou for first in found.scores[:1] for name, iou in first.iou.items()}
    return {"seconds": result.seconds, **found.costs, **found.metrics, **classes}


def _change(
    a: TaskResult, b: TaskResult | None, metric: str, errors: Mapping[str, str], sign: float, limit: float
) -> LogChange:
    before = _values(a).get(metric)
    if b is None:
        status = "failed" if a.log in errors else "missing"
        return LogChange(a.log, before, status=status, reason=errors.get(a.log, ""))
    after = _values(b).get(metric)
    if before is None or after is None:
        return LogChange(a.log, before, status="unscored")
    gain = sign * (after - before)
    return LogChange(a.log, before, after, "worse" if gain < -limit else "better" if gain > limit else "same")


def _rank(change: LogChange, sign: float) -> tuple[int, float, str]:
    gain = sign * (change.b - change.a) if change.a is not None and change.b is not None else 0.0
    order = list(_BAD)
    return order.index(change.status) if change.status in order else len(order), gain, change.log
