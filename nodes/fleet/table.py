"""Results of a store as tables for SQL, in an in-memory database of DuckDB."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec

from semantic_mapper.errors import ConfigError, DependencyError
from semantic_mapper.nodes.fleet.store import Store, TaskResult

_SQL = re.compile(r"\W*(select|with|from|pivot|unpivot|describe|summarize|show|values)\b", re.IGNORECASE)
_LOG_TEXTS = ("key", "operation", "log", "log_digest", "weights", "settings", "version", "node", "folder")
_COLUMNS = {
    "logs": {**dict.fromkeys(_LOG_TEXTS, "VARCHAR"), "seconds": "DOUBLE", "finished": "TIMESTAMP"},
    "classes": {**dict.fromkeys(("key", "method", "name"), "VARCHAR"), "iou": "DOUBLE"},
    "events": dict.fromkeys(("key", "kind", "text"), "VARCHAR"),
    "failures": {
        **dict.fromkeys(("operation", "log", "tags", "version", "error"), "VARCHAR"),
        "finished": "TIMESTAMP",
    },
}


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of a query: names of their columns, and values that JSON has."""

    names: tuple[str, ...]
    values: list[tuple[Any, ...]]


class Tables:
    """The results of a store as they are now.

    ``logs`` has a row for each result: each metric by its name, each cost as ``cost_NAME``, each tag as ``tag_NAME``;
    what only other results have is NULL. ``classes`` and ``events`` belong to it by ``key``. ``failures`` has a row for
    each log that failed and was not done since.

    Args:
        store: Is read once.

    Raises:
        ConfigError: a document is damaged.
        StoreError: the store cannot be reached.
        DependencyError: DuckDB is missing.
    """

    def __init__(self, store: Store) -> None:
        try:
            import duckdb
        except ModuleNotFoundError as error:
            raise DependencyError(
                f'tables of a fleet need the package duckdb ({error}): pip install "semantic-mapper[fleet]"'
            ) from error
        self._error = duckdb.Error
        self._database = duckdb.connect()
        kinds = {table: dict(columns) for table, columns in _COLUMNS.items()}
        with tempfile.TemporaryDirectory(prefix="semantic-mapper-fleet-") as folder, ExitStack() as stack:
            files = {table: stack.enter_context(Path(folder, f"{table}.json").open("wb")) for table in kinds}
            for table, row in _rows(store):
                for name, value in row.items():
                    kinds[table].setdefault(name, "VARCHAR" if isinstance(value, str) else "DOUBLE")
                files[table].write(msgspec.json.encode(row) + b"\n")
            stack.close()
            for table, columns in kinds.items():
                typed = ", ".join(f"{name}: '{kind}'" for name, kind in columns.items())
                source = f"'{folder}/{table}.json', format = 'newline_delimited', columns = {{{typed}}}"
                self._database.execute(f"CREATE TABLE {table} AS SELECT * FROM read_json({source})")
        self._database.execute("SET enable_external_access = false; SET lock_configuration = true")

    def query(self, text: str) -> Rows:
        """The rows that a query selects; it can read and write nothing but these tables.

        Args:
            text: A statement of SQL in DuckDB's dialect, or names of columns of ``logs``, such as ``log, miou``.

        Raises:
            ConfigError: DuckDB refuses it, in its words.
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
    """Rows with the tables that they belong to."""
    for result in store.results():
        key = result.key
        yield "logs", _log_row(result)
        for scores in result.findings.scores:
            for name, iou in scores.iou.items():
                yield "classes", {"key": key, "method": scores.method, "name": name, "iou": iou}
        for kind, text in result.findings.events:
            yield "events", {"key": key, "kind": kind, "text": text}
    for failure in store.failures():
        row = {name: getattr(failure, name) for name in ("operation", "log", "version", "error")}
        yield "failures", {**row, "tags": _json(failure.tags), "finished": _time(failure.finished_ns)}


def _log_row(result: TaskResult) -> dict[str, Any]:
    row: dict[str, Any] = {_column(name): value for name, value in result.findings.metrics.items()}
    row |= {_column(f"cost_{name}"): value for name, value in result.findings.costs.items()}
    row |= {_column(f"tag_{name}"): text for name, text in result.tags.items()}
    row |= {name: getattr(result, name) for name in (*_LOG_TEXTS, "seconds")}
    return {**row, "settings": _json(result.settings), "finished": _time(result.finished_ns)}


def _column(name: str) -> str:
    return re.sub(r"\W", "_", name.strip().lower(), flags=re.ASCII)


def _time(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).replace(tzinfo=None).isoformat(" ")


def _json(data: dict[str, Any]) -> str:
    return msgspec.json.encode(data, order="sorted").decode()


def _plain(value: Any) -> Any:
    """A value of DuckDB as JSON has it; what is neither number nor text becomes text."""
    if isinstance(value, float | Decimal):
        return float(value) if math.isfinite(value) else None
    return value if isinstance(value, int | str | None) else str(value)
