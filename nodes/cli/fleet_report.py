"""The page of ``fleet report``; its size is bounded, however many logs there are."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from semantic_mapper.errors import ConfigError, FleetError, StoreError
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.cli.fleet_results import cell_text
from semantic_mapper.nodes.fleet.compare import main_method
from semantic_mapper.nodes.fleet.metrics import Direction, direction_of
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.tables import Tables, column_name
from semantic_mapper.nodes.fleet.variants import Variant, operations, quoted, variants
from semantic_mapper.plain_text import counted
from semantic_mapper.plots import Histogram, PercentileBox, draw_boxes, draw_histograms
from semantic_mapper.replay.artifacts import REPORT_NAME
from semantic_mapper.replay.page import (
    Card,
    Picture,
    Section,
    linked,
    picture,
    safe_link,
    table_of,
    write_page,
)
from semantic_mapper.types import Float64

WORST = 12  # logs with their pictures
MAX_LOGS = 200  # rows of the table of logs
MAX_FAILURES = 50
MAX_CLASSES = 40
MAX_VERSIONS = 8
MAX_KINDS = 20
MAX_TAG_VALUES = 15
MAX_HISTOGRAMS = 9
MAX_ERROR = 2000  # letters
THUMBNAIL_WIDTH = 360
MAX_THUMBNAIL_BYTES = 16 * 2**20
# These metrics and costs come first.
_FIRST = ("miou", "map_miou", "total_accuracy", "labelled_pixels", "held_out_accuracy")
_FIRST += ("cost_step_ms_p50", "cost_step_ms_p95", "cost_map_memory_mb", "seconds")
_COLUMNS = 6  # figures in the table of logs
_NO_FIGURES = ("log_bytes", "attempts")
_PERCENTILES = "[0.05, 0.25, 0.5, 0.75, 0.95]"

_log = get_logger(__name__)


def write_fleet_report(store: Store, out: Path | None) -> Path:
    """Write ``report.html`` of all operations of a store.

    Args:
        store: Whose results.
        out: Folder for it; None = "report" in a local store, else ``runs/fleet-report``.

    Returns:
        The page.

    Raises:
        ConfigError: the store has neither results nor failures, or the page cannot be written.
        StoreError: the store cannot be reached.
        DependencyError: DuckDB or pyarrow is missing.
    """
    folder = out or (store.local / "report" if store.local else Path("runs/fleet-report"))
    with Tables(store) as tables:
        failed = list(_failures(tables))
        sections = [section for name in operations(tables) for section in _operation(tables, name, folder)]
    if not sections and not failed:
        raise ConfigError(f"{store.shown}: has no results yet; `fleet run` makes them")
    write_page(folder / REPORT_NAME, f"Fleet {store.shown}", [*failed, *sections])
    return folder / REPORT_NAME


def _failures(tables: Tables) -> Iterator[Section]:
    latest = """
        WITH latest AS (SELECT operation, arg_max(version, finished) AS version, max(finished) AS finished
                        FROM logs GROUP BY operation)
        SELECT f.*, coalesce(f.version <> l.version AND f.finished < l.finished, false) AS old
        FROM failures f LEFT JOIN latest l USING (operation)
        """
    (counts,) = tables.query(f"SELECT count(*) AS n, count_if(old)::BIGINT AS old FROM ({latest})").to_pylist()
    total, old = counts["n"], counts["old"]
    if not total:
        return
    rows = tables.query(
        f"SELECT operation, log, version, old, attempts, left(error, {MAX_ERROR}) AS error FROM ({latest}) "
        f"ORDER BY old, finished DESC, log LIMIT {MAX_FAILURES}",
    ).to_pylist()
    cells = [
        (
            row["log"],
            row["operation"],
            f"{row['version']} (older)" if row["old"] else row["version"],
            str(row["attempts"]),
            row["error"].split("\n")[-1],
        )
        for row in rows
    ]
    table = table_of(("log", "operation", "version", "attempts", "error"), cells)
    text = f"{counted(total, 'log')} failed"
    text += f", {old} of them in an older version than that of the latest results" if old else ""
    text += "" if total <= MAX_FAILURES else f"; the latest {MAX_FAILURES}"
    yield Section("Logs that were given up", [f"{text}."], tables=[table])


@dataclass(frozen=True, slots=True)
class _Figure:
    """A metric or cost of the latest variant.

    Args:
        column: In the table ``logs``.
        name: As results and ``fleet compare`` have it; costs as columns.
        values: (N,) of the logs that have one.
        same_as: Name of an earlier figure with the same values; empty = none has.
    """

    column: str
    name: str
    values: Float64
    same_as: str

    @property
    def telling(self) -> bool:
        """Whether it shows something that the figures before it do not."""
        return not self.same_as and _is_telling(self.values)

    @property
    def direction(self) -> Direction | None:
        """What is better; None for a cost, or a metric of which it is not known."""
        try:
            return None if self.is_cost else direction_of(self.name)
        except FleetError:
            return None

    @property
    def is_cost(self) -> bool:
        """Whether it belongs to the run, not to what was found."""
        return self.column.startswith("cost_") or self.column == "seconds"


def _operation(tables: Tables, operation: str, folder: Path) -> Iterator[Section]:
    """All sections of an operation: its latest variant, and the trend over variants."""
    found = variants(tables, operation)
    latest = found[0]
    where = latest.condition(operation)
    logs = tables.query(f"SELECT * FROM logs WHERE {where}")
    figures = _figures(logs, _metric_names(tables.store, latest))
    main = _main_figure(figures)
    left_out = [] if len(found) <= MAX_VERSIONS else [f"The latest {MAX_VERSIONS} of {len(found)}."]
    yield Section(f"{operation}: runs", tables=[_variants_table(tables, operation, found)], lines=left_out)
    if main is not None:
        yield from _trend(tables, operation, found, main)
    yield from _distributions(operation, figures, f"Logs of {latest.describe()}: {counted(logs.num_rows, 'log')}")
    yield from _classes(tables, operation, where)
    if main is not None:
        yield from _tags(tables, operation, where, main, logs.column_names)
    yield from _events(tables, operation, where)
    if main is not None:
        yield from _worst(tables, operation, where, main, folder, figures)


def _metric_names(store: Store, variant: Variant) -> dict[str, str]:
    """Names of metrics by their columns."""
    results = store.results(list(variant.keys.values())[:1])
    return {column_name(name): name for result in results for name in result.findings.metrics}


def _figures(table: Any, names: Mapping[str, str]) -> list[_Figure]:
    """Metrics and costs with a value, the most telling first."""
    import pyarrow as pa

    columns = [
        field.name for field in table.schema if pa.types.is_float64(field.type) and field.name not in _NO_FIGURES
    ]
    columns.sort(key=lambda n: (_FIRST.index(n) if n in _FIRST else len(_FIRST), n.startswith("cost_"), n))
    figures: list[_Figure] = []
    seen: dict[bytes, str] = {}
    for column in columns:
        name = names.get(column, column)
        every = np.asarray(table[column].to_numpy(), np.float64)
        values = every[np.isfinite(every)]
        if not len(values):
            continue
        same_as = seen.setdefault(every.tobytes(), name)
        figures.append(_Figure(column, name, values, "" if same_as == name else same_as))
    return figures


def _is_telling(values: Float64) -> bool:
    """Whether a figure differs between logs; that of a single log, where it is not 0."""
    return bool(np.ptp(values) > 0 if len(values) > 1 else values.any())


def _main_figure(figures: Sequence[_Figure]) -> _Figure | None:
    """What logs are ordered by: the first metric that differs and can be better or worse, else the first one."""
    metrics = [figure for figure in figures if not figure.is_cost]
    judged = [figure for figure in metrics if figure.direction in (Direction.HIGHER, Direction.LOWER)]
    return next(iter([*(figure for figure in judged if figure.telling), *judged, *metrics]), None)


def _distributions(operation: str, figures: Sequence[_Figure], caption: str) -> Iterator[Section]:
    """Of figures that differ between logs."""
    telling = [figure for figure in figures if figure.telling]
    shown, more = telling[:MAX_HISTOGRAMS], telling[MAX_HISTOGRAMS:]
    lines = [f"Not drawn: {', '.join(figure.name for figure in more)}."] if more else []
    constant = [f"{f.name} {cell_text(float(f.values[0]))}" for f in figures if not _is_telling(f.values)]
    lines += [f"The same in all logs: {', '.join(constant)}."] if constant else []
    twice = [f"{f.name} ({f.same_as})" for f in figures if f.same_as and _is_telling(f.values)]
    lines += [f"The same as another figure: {', '.join(twice)}."] if twice else []
    if shown or lines:
        histograms = [Histogram(f.name, _unit(f.column), f.values) for f in shown]
        drawn = [picture(draw_histograms(histograms), caption)] if shown else []
        yield Section(f"{operation}: distributions", pictures=drawn, lines=lines)


def _unit(name: str) -> str:
    """For the axis; figures in 0..1 and counts have none."""
    for word, unit in (("ms", "milliseconds"), ("mb", "MB"), ("bytes", "bytes"), ("seconds", "seconds")):
        if word in name.split("_"):
            return unit
    return "metres" if name.endswith("_m") else ""


def _variants_table(tables: Tables, operation: str, found: Sequence[Variant]) -> Any:
    rows = []
    for variant in found[:MAX_VERSIONS]:
        (row,) = tables.query(
            "SELECT count(*) AS logs, count(DISTINCT node) AS nodes, sum(seconds) AS seconds, "
            "sum(log_bytes)::DOUBLE AS bytes, max(finished) AS finished "
            f"FROM logs WHERE {variant.condition(operation)}",
        ).to_pylist()
        times = _duration_text(row["seconds"]), _size_text(row["bytes"]), str(row["finished"])[:16]
        rows.append((variant.describe(), str(row["logs"]), str(row["nodes"]), *times))
    return table_of(("version, weights, settings", "logs", "hosts", "time", "size of logs", "finished, UTC"), rows)


def _duration_text(seconds: float) -> str:
    return _with_unit(seconds, (("h", 3600), ("min", 60), ("s", 1)))


def _size_text(size: float) -> str:
    return _with_unit(size, (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3), ("bytes", 1)))


def _with_unit(value: float, units: Sequence[tuple[str, float]]) -> str:
    """In the largest unit of which there is at least one."""
    unit, scale = next((pair for pair in units if value >= pair[1]), units[-1])
    number = value / scale
    return f"{number:.0f} {unit}" if number >= 100 else f"{number:.{2 if number < 10 else 3}g} {unit}"


def _classes(tables: Tables, operation: str, where: str) -> Iterator[Section]:
    """Of the method that the metric "miou" is about."""
    scored = f"FROM classes WHERE isfinite(iou) AND key IN (SELECT key FROM logs WHERE {where})"
    (first,) = tables.query(f"SELECT min(key) AS key {scored}").to_pylist()
    if first["key"] is None:
        return
    (result,) = tables.store.results([first["key"]])
    method = main_method(result)
    rows = tables.query(
        f"""
        SELECT name, quantile_cont(iou, {_PERCENTILES}) AS percentiles, count(*) AS n, count(*) OVER () AS classes
        {scored} AND method = {quoted(method)} GROUP BY name ORDER BY n DESC, name LIMIT {MAX_CLASSES}
        """,
    ).to_pylist()
    others = tables.query(f"SELECT DISTINCT method {scored} AND method <> {quoted(method)} ORDER BY method")[
        "method"
    ].to_pylist()
    lines = []
    if rows and rows[0]["classes"] > len(rows):
        lines.append(f"{len(rows)} of {rows[0]['classes']} classes, those of most logs.")
    if others:
        lines.append(f"Method {method}, as miou. Not drawn: {'; '.join(others)}. The table classes has them.")
    boxes = [PercentileBox(row["name"], row["percentiles"], row["n"]) for row in rows]
    if boxes:
        drawn = _boxes(
            boxes, "IoU of a class in a log", f"IoU of classes, method {method}" if others else "IoU of classes"
        )
        yield Section(f"{operation}: classes", pictures=[drawn], lines=lines)


def _boxes(boxes: Sequence[PercentileBox], x_label: str, what: str) -> Picture:
    caption = f"{what}: quartiles and median over logs, whiskers from the 5th to the 95th percentile"
    return picture(draw_boxes("", boxes, x_label), caption)


def _worst(
    tables: Tables, operation: str, where: str, main: _Figure, folder: Path, figures: Sequence[_Figure]
) -> Iterator[Section]:
    order = "DESC" if main.direction is Direction.LOWER else ""
    shown = [main, *(f for f in figures if f.telling and f.column != main.column)][: _COLUMNS + 1]
    columns = ", ".join(f'"{figure.column}"' for figure in shown)
    rows = tables.query(
        f"SELECT key, operation, log, log_digest, weights_digest, folder, thumbnail, report, {columns} FROM logs "
        f'WHERE {where} AND isfinite("{main.column}") ORDER BY "{main.column}" {order}, log LIMIT {MAX_LOGS}',
    ).to_pylist()
    (total,) = tables.query(f"SELECT count(*) AS n FROM logs WHERE {where}")["n"].to_pylist()
    worst = rows[:WORST]
    pictured = [row if row["thumbnail"] else _pictured(tables, row) for row in worst]
    cards = [
        Card(
            "/".join(PurePosixPath(row["log"]).parts[-2:]),
            safe_link(_link(tables.store, row, folder)),
            _thumbnail(tables.store, of),
            [f"{figure.name} {cell_text(row[figure.column])}" for figure in shown[:3]],
        )
        for row, of in zip(worst, pictured, strict=True)
    ]
    judged = main.direction in (Direction.HIGHER, Direction.LOWER)
    by = f"worst logs by {main.name} ({main.direction})" if judged else f"logs with the least {main.name}"
    others = sorted({of["operation"] for of in pictured} - {operation})
    lines = [f"Pictures are of {', '.join(others)} with the same weights."] if others else []
    yield Section(f"{operation}: {by}", cards=cards, lines=lines)
    table = table_of(
        ("log", *(figure.name for figure in shown)),
        [
            (
                linked(row["log"], _link(tables.store, row, folder)),
                *(cell_text(row[figure.column]) for figure in shown),
            )
            for row in rows
        ],
    )
    for column in table.columns[1:]:
        column.justify = "right"
    lines = [] if total <= len(rows) else [f"{len(rows)} of {counted(total, 'log')}, the worst first."]
    yield Section(f"{operation}: logs", tables=[table], lines=lines)


def _pictured(tables: Tables, row: Mapping[str, Any]) -> Mapping[str, Any]:
    """The row of another result with a picture, of the same log with the same weights; else the row itself."""
    found = tables.query(
        f"""
        SELECT operation, log, folder, thumbnail FROM logs
        WHERE log_digest = {quoted(row["log_digest"])} AND weights_digest = {quoted(row["weights_digest"])}
            AND thumbnail <> '' ORDER BY finished DESC, key LIMIT 1
        """,
    ).to_pylist()
    return found[0] if found else row


def _link(store: Store, row: Mapping[str, Any], folder: Path) -> str:
    """To the page of a log: a relative path for a local store, a URL for one on the web, else nothing."""
    name = _file_name(row, "report")
    if not name:
        return ""
    if store.local is not None:
        # "./" keeps a name with a colon from being read as a scheme
        return "./" + quote(os.path.relpath(store.local.resolve() / name, folder.resolve()))
    return f"{store.url.rstrip('/')}/{quote(name)}" if store.url.startswith(("http://", "https://")) else ""


def _file_name(row: Mapping[str, Any], kind: str) -> str:
    """Of a file below the store; empty where the result has no such file, or it would lead out of the store."""
    if not row[kind]:
        return ""
    path = PurePosixPath(row["folder"]) / row[kind]
    return "" if path.is_absolute() or ".." in path.parts else str(path)


def _thumbnail(store: Store, row: Mapping[str, Any]) -> Picture | None:
    name = _file_name(row, "thumbnail")
    if not name:
        return None
    try:
        data = store.read_result_file(row["folder"], row["thumbnail"])
    except (ConfigError, StoreError) as error:
        _log.warning("thumbnail_missing", log=row["log"], error=str(error))
        return None
    pixels = None
    if 0 < len(data) <= MAX_THUMBNAIL_BYTES:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        _log.warning("thumbnail_damaged", log=row["log"], file=name)
        return None
    scale = min(THUMBNAIL_WIDTH / pixels.shape[1], 1.0)
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return picture(np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), np.uint8), row["log"], photo=True)


def _events(tables: Tables, operation: str, where: str) -> Iterator[Section]:
    rows = tables.query(
        f"""
        SELECT kind, count(*) AS n, count(DISTINCT key) AS logs, min(text) AS example, count(*) OVER () AS kinds
        FROM events WHERE key IN (SELECT key FROM logs WHERE {where})
        GROUP BY kind ORDER BY n DESC, kind LIMIT {MAX_KINDS}
        """,
    ).to_pylist()
    if not rows:
        return
    cells = [(row["kind"], str(row["n"]), str(row["logs"]), row["example"][:MAX_ERROR]) for row in rows]
    table = table_of(("kind", "events", "logs", "example"), cells)
    kinds = rows[0]["kinds"]
    lines = [] if kinds <= len(rows) else [f"{len(rows)} of {kinds} kinds, the most frequent first."]
    yield Section(f"{operation}: events", tables=[table], lines=lines)


def _trend(tables: Tables, operation: str, found: Sequence[Variant], main: _Figure) -> Iterator[Section]:
    """Over the logs that the latest variants share; those with less than half of the latest one's logs are left out."""
    latest = found[0].keys.keys()
    compared = [v for v in found if 2 * len(v.keys.keys() & latest) >= len(latest)][:MAX_VERSIONS]
    if len(compared) < 2:
        return
    text = " OR ".join(variant.condition(operation) for variant in compared)
    rows = tables.query(
        f"""
        WITH scored AS (SELECT log_digest, code, weights_digest, settings, "{main.column}" AS value FROM logs
                        WHERE ({text}) AND isfinite("{main.column}")),
             shared AS (SELECT log_digest FROM scored GROUP BY log_digest HAVING count(*) = {len(compared)})
        SELECT code, weights_digest, settings, quantile_cont(value, {_PERCENTILES}) AS percentiles, count(*) AS n
        FROM scored SEMI JOIN shared USING (log_digest) GROUP BY code, weights_digest, settings
        """,
    ).to_pylist()
    by_kind = {(row["code"], row["weights_digest"], row["settings"]): row for row in rows}
    boxes = [
        PercentileBox(variant.describe(), row["percentiles"], row["n"])
        for variant in reversed(compared)
        if (row := by_kind.get((variant.code, variant.weights_digest, variant.settings_text)))
    ]
    if boxes:
        what = f"{main.name} by version, the latest below, over the {counted(boxes[0].count, 'log')} that all have"
        yield Section(f"{operation}: trend", pictures=[_boxes(boxes, main.name, what)])


def _tags(tables: Tables, operation: str, where: str, main: _Figure, columns: Sequence[str]) -> Iterator[Section]:
    """Of tags with a few values."""
    pictures = []
    for column in columns:
        if not column.startswith("tag_"):
            continue
        rows = tables.query(
            f"""
            SELECT "{column}" AS value, quantile_cont("{main.column}", {_PERCENTILES}) AS percentiles, count(*) AS n
            FROM logs WHERE {where} AND "{column}" IS NOT NULL AND isfinite("{main.column}")
            GROUP BY value ORDER BY n DESC, value LIMIT {MAX_TAG_VALUES + 1}
            """,
        ).to_pylist()
        if 2 <= len(rows) <= MAX_TAG_VALUES:
            boxes = [PercentileBox(row["value"] or "(empty)", row["percentiles"], row["n"]) for row in rows]
            pictures.append(_boxes(boxes, main.name, f"{main.name} by {column.removeprefix('tag_')}"))
    if pictures:
        yield Section(f"{operation}: by tag", pictures=pictures)
