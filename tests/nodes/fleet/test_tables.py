"""Tables of a store: rows, readers beside writers, merged parts, and SQL that cannot leave them."""

from __future__ import annotations

import io
import multiprocessing
import os
from pathlib import Path

import msgspec
import pyarrow.parquet as pq
import pytest

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet import tables as module
from semantic_mapper.nodes.fleet.results import Failure
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.tables import TABLES, Tables, query
from tests.nodes.fleet.made_up import FINISHED_NS, NAMES, made_up, store_of

EACH = "SELECT count(*) AS n, count(DISTINCT key) AS keys FROM "


def counts(store: Store, table: str = "logs") -> tuple[int, int]:
    (row,) = query(store, EACH + table).to_pylist()
    return row["n"], row["keys"]


def refresh(store: Store) -> int:
    """Query, which adds results that the tables lack; returns how many rows the parts have more."""
    before = _saved_rows(store)
    query(store, "SELECT 1")
    return _saved_rows(store) - before


def _saved_rows(store: Store) -> int:
    names = store.names("tables/logs")
    return sum(pq.read_metadata(io.BytesIO(store.read(f"tables/logs/{name}"))).num_rows for name in names)


def test_a_log_is_a_row_with_its_metrics_costs_and_tags(tmp_path: Path) -> None:
    result = made_up(4, settings={"render.scale": 0.25})
    store = store_of(tmp_path / "store", [result])
    (row,) = query(store, "SELECT * FROM logs").to_pylist()
    assert row["key"] == result.key and row["miou"] == result.findings.metrics["miou"]
    assert row["cost_step_ms_p50"] == result.findings.costs["step_ms_p50"]
    assert (row["tag_robot"], row["tag_site"]) == ("r1", "south")
    assert row["finished"].timestamp() != 0 and msgspec.json.decode(row["settings"]) == {"render.scale": 0.25}
    assert [r["name"] for r in query(store, "SELECT name FROM classes").to_pylist()] == list(NAMES)
    (segment,) = query(store, "SELECT * FROM segments ORDER BY first LIMIT 1").to_pylist()
    assert tuple(segment["counts"]) == result.findings.segments[0].counts


def test_new_results_are_added_once(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(n) for n in range(5)])
    assert refresh(store) == 5 and refresh(store) == 0
    store_of(store.url, [made_up(n) for n in range(5, 8)])
    assert refresh(store) == 3
    assert counts(store) == (8, 8) and counts(store, "segments") == (8 * 12, 8)


def test_metrics_that_only_later_results_have_are_columns(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(1)])
    refresh(store)
    later = made_up(2)
    metrics = {**later.findings.metrics, "panoptic_quality": 0.4, "Seconds": 3.0}
    store.commit(msgspec.structs.replace(later, findings=msgspec.structs.replace(later.findings, metrics=metrics)))
    found = query(store, "SELECT panoptic_quality, metric_seconds FROM logs ORDER BY log").to_pylist()
    assert found == [{"panoptic_quality": None, "metric_seconds": None}, {"panoptic_quality": 0.4, "metric_seconds": 3}]


def test_results_that_were_deleted_are_no_rows(tmp_path: Path) -> None:
    results = [made_up(n) for n in range(3)]
    store = store_of(tmp_path / "store", results)
    refresh(store)
    store.remove(f"results/{results[1].key}", folder=True)
    assert counts(store) == (2, 2) and counts(store, "classes") == (2 * len(NAMES), 2)


def test_tasks_that_were_begun_are_no_rows_yet(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(0)])
    store.write("results/begun/attempt-1/map.npz", b"map")
    assert counts(store) == (1, 1)


@pytest.mark.parametrize("written", [1, 2, 3])
def test_a_writer_that_was_killed_leaves_nothing_twice_or_lost(tmp_path: Path, written: int) -> None:
    store = store_of(tmp_path / "store", [made_up(n) for n in range(3)])
    refresh(store)
    (part,) = store.names("tables/logs")
    for table in TABLES[: len(TABLES) - written]:  # those that come after the first ``written`` files
        os.unlink(tmp_path / "store" / "tables" / table / part)
    assert refresh(store) == 3
    for table, rows in (("logs", 3), ("classes", 3 * len(NAMES)), ("events", 1), ("segments", 36)):
        assert counts(store, table)[0] == rows


def test_results_that_two_writers_added_are_rows_once(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(n) for n in range(4)])
    refresh(store)
    (tmp_path / "store" / "tables").rename(tmp_path / "aside")
    refresh(store)
    for table in TABLES:
        (file,) = (tmp_path / "aside" / table).iterdir()
        file.rename(tmp_path / "store" / "tables" / table / file.name)
    assert len(store.names("tables/logs")) == 2
    assert counts(store) == (4, 4) and counts(store, "events") == (2, 2)


def test_small_parts_are_merged_without_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_SMALL_PARTS", 3)
    store = Store(str(tmp_path / "store"), create=True)
    for number in range(8):
        store.commit(made_up(number))
        refresh(store)
        assert counts(store) == (number + 1, number + 1)
        assert counts(store, "segments") == (12 * (number + 1), number + 1)
    assert len(store.names("tables/logs")) <= 4
    assert all(store.names(f"tables/{table}") == store.names("tables/logs") for table in TABLES)


def test_old_files_of_parts_that_never_counted_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_SMALL_PARTS", 1)
    store = store_of(tmp_path / "store", [made_up(0)])
    refresh(store)
    store.write("tables/segments/part-00000000000000000001-abcd.parquet", b"half")
    recent = module._part_name()
    store.write(f"tables/segments/{recent}", b"a writer is at it")
    store.commit(made_up(1))
    refresh(store)
    assert sorted(store.names("tables/segments")) == sorted([*store.names("tables/logs"), recent])


def _add(url: str, first: int, count: int) -> None:
    module.MAX_SMALL_PARTS = 2
    store = Store(url)
    for number in range(first, first + count):
        store.commit(made_up(number))
        refresh(store)


@pytest.mark.slow
def test_readers_see_each_result_once_while_others_add_and_merge(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(n) for n in range(3)])
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_add, args=(store.url, 100 * n, 8)) for n in (1, 2)]
    for writer in writers:
        writer.start()
    seen = [counts(store)]
    while any(writer.is_alive() for writer in writers):
        seen.append(counts(store))
        rows, keys = counts(store, "segments")
        assert rows == 12 * keys
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert all(rows == keys for rows, keys in seen) and seen == sorted(seen)
    assert counts(store) == (19, 19)


def test_a_store_that_can_only_be_read_is_queried_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_of(tmp_path / "store", [made_up(n) for n in range(3)])

    def refuse(self: Store, name: str, data: bytes) -> None:
        raise StoreError(f"{name}: is refused")  # root may write everywhere, so permissions cannot be taken away

    monkeypatch.setattr(Store, "write", refuse)
    assert counts(store) == (3, 3) and counts(store, "segments") == (36, 3)


def test_tables_of_a_remote_store_are_the_same() -> None:
    store = store_of("memory://fleet-tables", [made_up(n) for n in range(3)])
    assert refresh(store) == 3 and counts(store) == (3, 3) and counts(store, "segments") == (36, 3)
    (count,) = query(store, "SELECT count(*) AS n FROM logs JOIN classes USING (key)").to_pylist()
    assert count["n"] == 3 * len(NAMES)


def test_quarantined_tasks_are_rows_of_failures(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(0)])
    store.quarantine(Failure("k", "replay", "/logs/x.mcap", {"robot": "r9"}, "0.1.0", ("first", "last"), FINISHED_NS))
    (row,) = query(store, "SELECT log, error, attempts, tags ->> 'robot' AS robot FROM failures").to_pylist()
    assert row == {"log": "/logs/x.mcap", "error": "last", "attempts": 2, "robot": "r9"}


def test_failures_of_logs_that_another_version_has_done_since_are_no_rows(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(n) for n in range(4)])
    logs = [made_up(n).log for n in range(4)]
    for n, (operation, version, finished_ns) in enumerate(
        [
            ("replay", "0.0.9", FINISHED_NS - 1),  # done since
            ("replay", "0.2.0", FINISHED_NS + 10**15),  # a later version fails
            ("eval", "0.0.9", FINISHED_NS - 1),  # only another operation has been done
            ("replay", made_up(3).version, FINISHED_NS - 1),  # with other weights, say
        ]
    ):
        store.quarantine(Failure(f"k{n}", operation, logs[n], {}, version, ("E: no",), finished_ns))
    assert [row["log"] for row in query(store, "SELECT log FROM failures ORDER BY log").to_pylist()] == logs[1:]


def test_an_empty_store_has_empty_tables(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "store"), create=True)
    assert query(store, "SELECT * FROM logs JOIN events USING (key)").num_rows == 0
    with Tables(store) as tables:
        assert ("error", "VARCHAR") in tables.columns()["failures"]


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("SELEC 1", "syntax error"),
        ("SELECT moiu FROM logs", "moiu"),
        ("SELECT * FROM read_text('{file}')", "disabled by configuration"),
        ("SELECT * FROM '{file}'", "does not exist"),
        ("COPY logs TO '{file}.csv'", "disabled by configuration"),
        ("ATTACH '{file}.db'", "disabled by configuration"),
        ("INSTALL httpfs", "disabled by configuration"),
        ("SET enable_external_access = true", "locked"),
    ],
)
def test_sql_that_is_wrong_or_leaves_the_tables_is_refused(tmp_path: Path, sql: str, said: str) -> None:
    store = store_of(tmp_path / "store", [made_up(0)])
    file = tmp_path / "secret"
    file.write_text("secret")
    with pytest.raises(ConfigError, match=said):
        query(store, sql.format(file=file))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["secret", "store"]


def test_a_damaged_part_is_named_with_how_to_mend_it(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(0)])
    refresh(store)
    (part,) = store.names("tables/logs")
    store.write(f"tables/logs/{part}", b"PAR1 no more")
    with pytest.raises(ConfigError, match="delete `tables`"):
        query(store, "SELECT 1")
