"""Results of a store as tables: Parquet parts, and SQL over them.

A part is four files of one name, one in each folder of ``tables/``: logs, classes, events and segments of the same
results. The one in ``tables/logs`` is written last and removed first, so a part counts where it is there. A row names
its part; where two parts hold a key, the rows of the older part count. So two processes may add the same results at a
time, be killed, or merge parts, and readers see each result once. Results that are gone are left out.
"""

from __future__ import annotations

import re
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import msgspec
import numpy as np

from semantic_mapper.errors import ConfigError, DependencyError, StoreError
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.fleet.results import Failure, TaskResult
from semantic_mapper.nodes.fleet.store import Store

if TYPE_CHECKING:
    import pyarrow as pa

TABLES = ("logs", "classes", "events", "segments")
FAILURES = "failures"
PART_RESULTS = 2000  # a part is closed after this many results ...
PART_COUNTS = 8_000_000  # ... or this many counts of segments: 64 MB in memory
MAX_SMALL_PARTS = 32  # more of them are merged
BATCH_ROWS = 2000  # that are in memory while parts are merged
ORPHAN_S = 86_400.0  # files of parts that were never finished are removed after this time
_TRIES = 20  # where other processes merge the parts that are read

_log = get_logger(__name__)
_T = TypeVar("_T")


def query(store: Store, sql: str) -> pa.Table:
    """The rows that one statement selects; see ``Tables.query``."""
    with Tables(store) as tables:
        return tables.query(sql)


class Tables:
    """Reads the tables of a store; a context manager. The first query adds results that they lack.

    Into a store that can only be read nothing is added: the event ``tables_not_saved`` is logged, and the rows are
    derived for this reader alone.

    Args:
        store: Whose results.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self._folder = tempfile.TemporaryDirectory(prefix="semantic-mapper-fleet-")
        self._listed: list[str] = []
        self._parts: _Parts | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    def query(self, sql: str) -> pa.Table:
        """The rows that a statement of SQL selects.

        The statement sees the views ``logs``, ``classes``, ``events``, ``segments`` and ``failures``, in DuckDB's
        dialect. It can neither read nor write anything else: DuckDB runs without access to files and network.

        Args:
            sql: A statement that returns rows.

        Raises:
            ConfigError: DuckDB refuses the statement, in its words; or a document or part is damaged.
            StoreError: the store cannot be reached.
            DependencyError: DuckDB or pyarrow is missing.
        """
        named = {word.lower() for word in re.findall(r"\w+", sql)}
        return self._retried(lambda parts: _select(self.store, parts, sql, named))

    def columns(self) -> dict[str, list[tuple[str, str]]]:
        """Name and type of each column, by table.

        Raises:
            ConfigError, StoreError, DependencyError: as ``query``.
        """
        views = (*TABLES, FAILURES)
        found = {view: self.query(f"SELECT column_name, column_type FROM (DESCRIBE {view})") for view in views}
        return {
            view: [(row["column_name"], row["column_type"]) for row in table.to_pylist()]
            for view, table in found.items()
        }

    def _retried(self, use: Callable[[_Parts], _T]) -> _T:
        """Do something with all parts; again where another process has merged some of them in between."""
        duckdb = _duckdb()
        for tries_left in reversed(range(_TRIES)):
            try:
                if self._parts is None:
                    self._listed = _listed(self.store)
                    self._parts = _up_to_date(self.store, self._listed, Path(self._folder.name))
                return use(self._parts)
            except (OSError, duckdb.Error) as error:  # StoreError is an OSError
                if tries_left and not set(self._listed) <= set(self.store.names("tables/logs")):
                    self._parts = None
                    continue
                if isinstance(error, duckdb.Error):
                    raise ConfigError(f"SQL: {error}") from error
                raise
        raise AssertionError("unreachable")


def column_name(name: str, prefix: str = "") -> str:
    """A metric, cost or tag as a column: lower case, letters, digits and "_"."""
    return prefix + (re.sub(r"\W", "_", name.strip().lower(), flags=re.ASCII) or "_")


# Rows of results


def _schemas() -> dict[str, pa.Schema]:
    """Columns that are always there; "part" is for this module only."""
    import pyarrow as pa

    text, whole, number = pa.string(), pa.int64(), pa.float64()
    kinds = {
        "logs": (
            ("key", text),
            ("operation", text),
            ("log", text),
            ("log_digest", text),
            ("log_bytes", whole),
            ("weights", text),
            ("weights_digest", text),
            ("settings", text),
            ("tags", text),
            ("version", text),
            ("code", text),
            ("attempts", whole),
            ("seconds", number),
            ("node", text),
            ("finished", pa.timestamp("us")),
            ("folder", text),
            ("thumbnail", text),
            ("report", text),
        ),
        "classes": (("key", text), ("method", text), ("name", text), ("iou", number)),
        "events": (("key", text), ("kind", text), ("text", text), ("seq", whole), ("stamp_ns", whole)),
        "segments": (
            ("key", text),
            ("method", text),
            ("first", whole),
            ("frames", whole),
            ("names", pa.list_(text)),
            ("counts", pa.list_(whole)),
        ),
    }
    return {table: pa.schema([*fields, ("part", text)]) for table, fields in kinds.items()}


def _failure_schema() -> pa.Schema:
    import pyarrow as pa

    text = pa.string()
    fields = ("key", text), ("operation", text), ("log", text), ("tags", text), ("version", text), ("error", text)
    return pa.schema([*fields, ("attempts", pa.int64()), ("finished", pa.timestamp("us"))])


def _log_row(result: TaskResult) -> dict[str, Any]:
    found = result.findings
    row: dict[str, Any] = {
        name: getattr(result, name)
        for name in ("key", "operation", "log", "log_digest", "log_bytes", "weights", "weights_digest", "version")
    }
    row |= {name: getattr(result, name) for name in ("code", "attempts", "seconds", "node", "folder")}
    row |= {"settings": _json(result.settings), "tags": _json(result.tags), "finished": result.finished_ns // 1000}
    row |= {"thumbnail": found.thumbnail, "report": found.report}
    fixed = {*row, "part"}
    for name, value in found.metrics.items():
        plain = column_name(name)
        taken = plain in fixed or plain.startswith(("tag_", "cost_"))
        row.setdefault(f"metric_{plain}" if taken else plain, None if value is None else float(value))
    for name, value in found.costs.items():
        row.setdefault(column_name(name, "cost_"), None if value is None else float(value))
    for name, text in result.tags.items():
        row.setdefault(column_name(name, "tag_"), text)
    return row


def _failure_row(failure: Failure) -> dict[str, Any]:
    row: dict[str, Any] = {name: getattr(failure, name) for name in ("key", "operation", "log", "version")}
    last = failure.errors[-1] if failure.errors else ""
    row |= {"tags": _json(failure.tags), "error": last, "attempts": len(failure.errors)}
    return row | {"finished": failure.finished_ns // 1000}


def _json(data: Any) -> str:
    return msgspec.json.encode(data, order="sorted").decode()


def _part_name() -> str:
    """Older parts come first in alphabetical order."""
    return f"part-{time.time_ns():020d}-{secrets.token_hex(4)}.parquet"


class _PartDraft:
    """Rows of one part, collected in memory."""

    def __init__(self) -> None:
        self.name = _part_name()
        self.keys: list[str] = []
        self.counts = 0
        self._rows: dict[str, list[dict[str, Any]]] = {table: [] for table in TABLES}

    def add(self, result: TaskResult) -> None:
        self.keys.append(result.key)
        self._rows["logs"].append(_log_row(result))
        for table, found in (("classes", result.findings.classes), ("events", result.findings.events)):
            self._rows[table] += [{"key": result.key, **msgspec.structs.asdict(row)} for row in found]
        for segment in result.findings.segments:
            row = {"key": result.key, **msgspec.structs.asdict(segment)}
            self._rows["segments"].append({**row, "counts": np.asarray(segment.counts, np.int64)})
            self.counts += len(segment.counts)

    @property
    def full(self) -> bool:
        return len(self.keys) >= PART_RESULTS or self.counts >= PART_COUNTS

    def write(self, folder: Path) -> None:
        """To FOLDER/TABLE/NAME."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        for table, schema in _schemas().items():
            rows = self._rows[table]
            for name in dict.fromkeys(name for row in rows for name in row):
                if name not in schema.names:
                    kind = pa.string() if name.startswith("tag_") else pa.float64()
                    schema = schema.append(pa.field(name, kind))
            arrays = [
                pa.array([self.name] * len(rows) if f.name == "part" else [row.get(f.name) for row in rows], f.type)
                for f in schema
            ]
            (folder / table).mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.Table.from_arrays(arrays, schema=schema), folder / table / self.name, compression="zstd")


# Parts


@dataclass(slots=True)
class _Parts:
    """Parts as one reader sees them.

    Attributes:
        folder: Of this reader: what it has fetched or made.
        owner: The part that counts, by key.
    """

    folder: Path
    owner: dict[str, str] = field(default_factory=dict)

    def names(self) -> list[str]:
        return sorted(set(self.owner.values()))


def _listed(store: Store) -> list[str]:
    """Names of the parts that are whole.

    Raises:
        StoreError: files of a part are missing, and no other process is removing them.
    """
    missing: set[str] = set()
    for _ in range(_TRIES):
        names = [name for name in store.names("tables/logs") if name.endswith(".parquet")]
        missing = {name for table in TABLES[1:] for name in set(names) - set(store.names(f"tables/{table}"))}
        if not missing:
            return names
    raise StoreError(f"{store.shown}/tables: files of {min(missing)} are missing; delete `tables`, it is made again")


def _up_to_date(store: Store, names: Sequence[str], folder: Path) -> _Parts:
    """Read which results the parts hold, and add those that are missing."""
    parts = _Parts(folder)
    rows: dict[str, int] = {}
    for name in names:
        keys = _read_keys(store, _fetch(store, parts, "logs", name))
        rows[name] = len(keys)
        for key in keys:
            parts.owner.setdefault(key, name)
    live = set(store.keys())
    unknown = sorted(live - parts.owner.keys())
    parts.owner = {key: name for key, name in parts.owner.items() if key in live}
    saved = True
    for draft in _drafts(store, unknown):
        draft.write(folder)
        parts.owner.update(dict.fromkeys(draft.keys, draft.name))
        rows[draft.name] = len(draft.keys)
        saved = saved and _save(store, folder, draft.name)
    small = [name for name, count in rows.items() if count < PART_RESULTS]
    if saved and len(small) > MAX_SMALL_PARTS:
        _merge(store, parts, small)
    return parts


def _drafts(store: Store, keys: Sequence[str]) -> Iterator[_PartDraft]:
    draft = _PartDraft()
    for result in store.results(keys):
        draft.add(result)
        if draft.full:
            yield draft
            draft = _PartDraft()
    if draft.keys:
        yield draft


def _save(store: Store, folder: Path, name: str) -> bool:
    """Put a part into the store, the file that makes it count last; False where the store can only be read."""
    try:
        for table in reversed(TABLES):
            store.write(f"tables/{table}/{name}", (folder / table / name).read_bytes())
    except StoreError as error:
        _log.warning("tables_not_saved", store=store.shown, error=str(error))
        return False
    return True


def _fetch(store: Store, parts: _Parts, table: str, name: str) -> Path:
    """Where a file of a part is on this machine."""
    own = parts.folder / table / name
    if own.exists():
        return own
    if store.local is not None:
        return store.local / "tables" / table / name
    own.parent.mkdir(exist_ok=True)
    store.download(f"tables/{table}/{name}", own)
    return own


def _read_keys(store: Store, file: Path) -> list[str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_table(file, columns=["key"])["key"].to_pylist()
    except pa.ArrowInvalid as error:
        raise ConfigError(
            f"{store.shown}/tables/logs/{file.name}: is damaged ({error}); delete `tables`, it is made again"
        ) from error


def _dataset(store: Store, parts: _Parts, table: str, names: Sequence[str]) -> Any:
    """The files of some parts as one ``pyarrow`` data set; columns that a file lacks are null there."""
    import pyarrow as pa
    import pyarrow.dataset as ds
    import pyarrow.parquet as pq

    files = [_fetch(store, parts, table, name) for name in names]
    try:
        schema = pa.unify_schemas([_schemas()[table], *(pq.read_schema(file) for file in files)])
    except pa.ArrowInvalid as error:
        raise ConfigError(
            f"{store.shown}/tables/{table}: is damaged ({error}); delete `tables`, it is made again"
        ) from error
    return ds.dataset(files, schema=schema, format="parquet") if files else schema.empty_table()


def _merge(store: Store, parts: _Parts, small: Sequence[str]) -> None:
    """Make one part of many, then remove these; this reader goes on with the new one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    name = _part_name()
    for table in TABLES:
        source = _dataset(store, parts, table, sorted(small))
        (parts.folder / table).mkdir(exist_ok=True)
        with pq.ParquetWriter(parts.folder / table / name, source.schema, compression="zstd") as writer:
            for batch in source.to_batches(batch_size=BATCH_ROWS, batch_readahead=1, fragment_readahead=1):
                pairs = zip(batch["key"].to_pylist(), batch["part"].to_pylist(), strict=True)
                kept = batch.filter(pa.array([parts.owner.get(key) == part for key, part in pairs], pa.bool_()))
                at = kept.schema.get_field_index("part")
                writer.write_batch(kept.set_column(at, "part", pa.array([name] * len(kept), pa.string())))
    if not _save(store, parts.folder, name):
        return
    merged = set(small)
    parts.owner = {key: name if part in merged else part for key, part in parts.owner.items()}
    for table in TABLES:
        for old in small:
            store.remove(f"tables/{table}/{old}")
    _remove_orphans(store)
    _log.info("tables_merged", store=store.shown, parts=len(small))


def _remove_orphans(store: Store) -> None:
    """Remove files of parts whose writer was killed before they counted."""
    whole = set(store.names("tables/logs"))
    limit = f"part-{time.time_ns() - int(ORPHAN_S * 1e9):020d}"
    for table in TABLES[1:]:
        for name in store.names(f"tables/{table}"):
            if name not in whole and name < limit:
                store.remove(f"tables/{table}/{name}")


# SQL


def _select(store: Store, parts: _Parts, sql: str, named: set[str]) -> pa.Table:
    import pyarrow as pa

    duckdb = _duckdb()
    with duckdb.connect(config={"temp_directory": str(parts.folder / "spilled")}) as database:
        needed = named | {"logs"} if FAILURES in named else named
        chosen = pa.table({"key": list(parts.owner), "part": list(parts.owner.values())}, _chosen_schema())
        database.register("_chosen", chosen)
        for table in TABLES:
            # Segments are most of the bytes; files of a remote store are fetched only where the statement needs them.
            names = parts.names() if table in needed else []
            database.register(f"_{table}", _dataset(store, parts, table, names))
            database.execute(
                f"CREATE VIEW {table} AS SELECT * EXCLUDE (part) FROM _{table} SEMI JOIN _chosen USING (key, part)"
            )
        failures = [_failure_row(f) for f in store.failures()] if FAILURES in named else []
        database.register("_failures", pa.Table.from_pylist(failures, _failure_schema()))
        database.execute(
            f"CREATE VIEW {FAILURES} AS SELECT * FROM _failures f WHERE NOT EXISTS (FROM logs l WHERE "
            "l.log = f.log AND l.operation = f.operation AND l.version <> f.version AND l.finished > f.finished)"
        )
        database.execute("SET enable_external_access = false")
        database.execute("SET lock_configuration = true")
        found = database.sql(sql)
        if found is None:
            raise ConfigError(f"SQL: {sql!r} returns no rows; give one SELECT")
        return found.to_arrow_table()


def _chosen_schema() -> pa.Schema:
    import pyarrow as pa

    return pa.schema([("key", pa.string()), ("part", pa.string())])


def _duckdb() -> Any:
    """The package; with it, pyarrow is there.

    Raises:
        DependencyError: one of them is missing.
    """
    try:
        import duckdb
        import pyarrow as _  # noqa: F401
    except ImportError as error:
        raise DependencyError(
            f'{error}; tables of a fleet need `pip install "semantic-mapper[fleet]"`, or `make setup` in a checkout'
        ) from error
    return duckdb


def plain_rows(table: pa.Table) -> list[Mapping[str, Any]]:
    """Rows for JSON: times as text, NaN and infinities as None."""
    return [{name: _plain(value) for name, value in row.items()} for row in table.to_pylist()]


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    return value if value is None or isinstance(value, (str, int, bool)) else str(value)
