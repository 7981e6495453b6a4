"""Results as tables: rows and columns, and SQL that cannot leave them."""

import json
from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.results import Tables
from tests.nodes.fleet.made_up import NAMES, failure_of, made_up, store_of


def test_a_log_is_a_row_with_its_metrics_costs_and_tags(tmp_path: Path) -> None:
    result = made_up(4, settings={"render": {"scale": 0.25}})
    store = store_of(tmp_path, [result, made_up(5, tags={"what-for": "test"})])
    store.note_failure(failure_of(result))
    tables = Tables(store)
    found = tables.query("SELECT * FROM logs ORDER BY log")
    row = dict(zip(found.names, found.values[0], strict=True))
    assert row["key"] == result.key and row["miou"] == result.findings.metrics["miou"]
    assert (row["cost_step_ms_p50"], row["depth_disagreement"]) == (34.0, None)
    assert (row["tag_robot"], row["tag_what_for"]) == ("r1", None) and row["finished"].startswith("2026-09-")
    assert json.loads(row["settings"]) == {"render": {"scale": 0.25}}
    assert [r[0] for r in tables.query("SELECT name FROM classes JOIN logs USING (key) LIMIT 4").values] == list(NAMES)
    assert tables.query("FROM failures").values[0][:2] == ("map", result.log)
    assert tables.query("SELECT kind, text FROM events").values == [("refused", "frame 7: pose jumps")] * 2
    assert tables.columns()["logs"][:3] == ("key", "operation", "log")
    found = tables.query("log, round(miou, 1) AS miou")  # columns alone are those of logs
    assert found.names == ("log", "miou") and len(found.values) == 2
    sql = "SELECT 'nan'::DOUBLE, 1.5::DECIMAL(4, 1), DATE '2026-01-02', [1, 2], sum(1), true"
    (values,) = tables.query(sql).values
    assert json.loads(json.dumps(values, allow_nan=False)) == [None, 1.5, "2026-01-02", "[1, 2]", 1, True]


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT * FROM read_text('{file}')",
        "COPY logs TO '{file}.csv'",
        "SET enable_external_access = true",
        "INSTALL httpfs",
        "nothing_of_the_kind",
        "",
    ],
)
def test_sql_reads_and_writes_nothing_else(tmp_path: Path, sql: str) -> None:
    file = tmp_path / "secret.csv"
    file.write_text("a\n1\n")
    tables = Tables(store_of(tmp_path / "store", [made_up(1)]))
    with pytest.raises(ConfigError, match="SQL: "):
        tables.query(sql.format(file=file))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["secret.csv", "store"]
