"""``fleet table``, ``report`` and ``compare``: what they print and write, and their exit codes."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from semantic_mapper import plots
from semantic_mapper.nodes.cli import fleet_report
from semantic_mapper.nodes.fleet.results import ClassRow, Failure, TaskResult
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.plots import Histogram, PercentileBox
from semantic_mapper.replay.page import linked, safe_link
from semantic_mapper.types import UInt8
from tests.nodes.fleet.made_up import FINISHED_NS, made_up, store_of, with_files
from tests.nodes.support import error_line, run
from tests.replay.test_page import cells, pictures, read_page

DOCS = Path(__file__).resolve().parents[3] / "docs" / "fleet-results.md"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Two versions of 8 logs; the later one with files and a log that failed."""
    store = store_of(tmp_path / "store", [made_up(n) for n in range(8)])
    for number in range(8):
        later = made_up(
            number, loss=0.02, version="0.2.0", code="d" * 64, finished_ns=FINISHED_NS + (number + 1) * 10**12
        )
        store.commit(with_files(store, later))
    failed = Failure("f", "replay", "/logs/bad <b>.mcap", {}, "0.2.0", ("LogError: is cut off",), FINISHED_NS)
    store.quarantine(failed)
    return store


def test_table_prints_the_rows_of_a_query(store: Store) -> None:
    done = run("fleet", "table", store.url, "SELECT log, miou FROM logs WHERE version = '0.2.0' ORDER BY miou LIMIT 2")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.strip().splitlines()) == 3 and "/logs/000" in done.stdout


def test_table_without_sql_shows_an_overview_and_the_columns(store: Store) -> None:
    done = run("fleet", "table", store.url)
    assert done.returncode == 0, done.stderr
    assert "miou_median" in done.stdout and "LogError: is cut off" in done.stdout and "tag_robot" in done.stdout
    found = json.loads(run("fleet", "table", store.url, "--json").stdout)
    assert [row["logs"] for row in found["overview"]] == [8, 8] and found["columns"]["classes"]["iou"] == "DOUBLE"


def test_table_writes_csv_parquet_and_json(store: Store, tmp_path: Path) -> None:
    sql = "SELECT key, first, names, finished FROM segments JOIN logs USING (key) ORDER BY key, first LIMIT 3"
    done = run("fleet", "table", store.url, sql, "--csv", tmp_path / "a.csv", "--out", tmp_path / "a.parquet", "--json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["key"] for row in rows] == [row["key"] for row in printed]
    names = pq.read_table(tmp_path / "a.parquet")["names"][0].as_py()
    assert json.loads(rows[0]["names"]) == printed[0]["names"] == names


def test_wrong_sql_is_an_error_in_the_words_of_duckdb(store: Store) -> None:
    done = run("fleet", "table", store.url, "SELECT moiu FROM logs")
    assert done.returncode == 1 and "moiu" in error_line(done.stderr) and not done.stdout


def test_what_is_no_store_says_so(tmp_path: Path) -> None:
    for verb in (("table",), ("report",)):
        done = run("fleet", *verb, tmp_path)
        assert done.returncode == 1 and "is no fleet store" in error_line(done.stderr)
    assert run("fleet", "compare", tmp_path, tmp_path).returncode == 2


@pytest.mark.parametrize("sql", re.findall(r"```sql\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL))
def test_queries_of_the_documentation_run(store: Store, sql: str) -> None:
    done = run("fleet", "table", store.url, sql, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)


def test_report_has_pictures_links_failures_and_trend(store: Store) -> None:
    done = run("fleet", "report", store.url)
    assert done.returncode == 0, done.stderr
    assert store.local is not None
    path = store.local / "report" / "report.html"
    assert str(path) in done.stdout
    page = read_page(path, links=True)
    links = [element.get("href") or "" for element in page.iter("a")]
    assert len(links) == 16 and all((path.parent / link).resolve().name == "report.html" for link in links)
    assert all((path.parent / link).is_file() for link in links)
    heads = [element.text for element in page.iter("h2")]
    assert heads[:1] == ["Logs that were given up"] and {"replay: trend", "replay: by tag"} <= set(heads)
    assert len(pictures(page)) >= 8 + 4
    assert "bad &lt;b&gt;.mcap" in path.read_text(encoding="utf-8")


def test_report_says_which_failures_are_of_an_older_version(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [made_up(n, weights="") for n in range(3)])
    version = made_up(0).version
    for name, of, log in (
        ("old", "0.0.9", "/logs/old.mcap"),
        ("new", version, "/logs/new.mcap"),
        ("done", "0.0.9", made_up(1).log),
    ):
        store.quarantine(Failure(name, "replay", log, {}, of, ("E: no",), FINISHED_NS - 1))
    done = run("fleet", "report", store.url, "--out", tmp_path / "page")
    assert done.returncode == 0, done.stderr
    page = read_page(tmp_path / "page" / "report.html")
    found = cells(page)
    assert found["/logs/old.mcap"][1] == "0.0.9 (older)" and found["/logs/new.mcap"][1] == version
    assert any((p.text or "").startswith("2 logs failed, 1 of them in an older version") for p in page.iter("p"))
    assert f"{version}, weights default" in found


@pytest.mark.parametrize(
    ("values", "shown"), [([0, 0], False), ([3, 3], False), ([3, 4], True), ([3], True), ([0], False)]
)
def test_figures_that_say_nothing_are_not_drawn(values: list[float], shown: bool) -> None:
    assert fleet_report._is_telling(np.array(values, np.float64)) == shown


@pytest.mark.parametrize(
    ("seconds", "size", "shown"),
    [(0.4, 1000, "0.4 s, 1 kB"), (36, 15_900_000, "36 s, 15.9 MB"), (138, 2.5e9, "2.3 min, 2.5 GB")],
)
def test_times_and_sizes_have_units_that_fit(seconds: float, size: float, shown: str) -> None:
    assert f"{fleet_report._duration_text(seconds)}, {fleet_report._size_text(size)}" == shown


def test_a_candidate_without_results_exits_with_1_and_its_errors(tmp_path: Path) -> None:
    results = [made_up(n) for n in range(2)]
    a, b = store_of(tmp_path / "a", results), Store(str(tmp_path / "b"), create=True)
    for n, result in enumerate(results):
        b.quarantine(Failure(f"k{n}", "replay", result.log, {}, "0.2.0", ("WeightsError: no",), FINISHED_NS))
    done = run("fleet", "compare", a.url, b.url)
    assert done.returncode == 1 and "worse: 2 logs failed in B" in done.stdout, done.stderr
    assert "WeightsError" in done.stdout and "nan" not in done.stdout
    assert json.loads(run("fleet", "compare", a.url, b.url, "--json").stdout)["worse"]


def test_report_of_one_log_without_files_or_score(tmp_path: Path) -> None:
    plain = made_up(0)
    findings = msgspec.structs.replace(plain.findings, metrics={"miou": None}, classes=(), segments=(), costs={})
    store = store_of(tmp_path / "one", [msgspec.structs.replace(plain, findings=findings)])
    done = run("fleet", "report", store.url, "--out", tmp_path / "page")
    assert done.returncode == 0, done.stderr
    assert read_page(tmp_path / "page" / "report.html") is not None


def test_report_of_an_empty_store_says_that_nothing_is_there(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "empty"), create=True)
    done = run("fleet", "report", store.url)
    assert done.returncode == 1 and "has no results yet" in error_line(done.stderr)


@pytest.mark.parametrize("link", ["javascript:alert(1)", "data:text/html,x", " javascript:x", "file:///etc/passwd"])
def test_links_lead_to_pages_only(link: str) -> None:
    assert safe_link(link) == "" and not str(getattr(linked("x", link).style, "link", None) or "")


def evaluated(number: int) -> TaskResult:
    """As ``eval`` writes it: several methods, figures that are constant, and one that is there twice; no picture."""
    result = made_up(number, operation="eval")
    found, miou = result.findings, result.findings.metrics["miou"]
    assert miou is not None
    metrics = {"miou": miou, "miou sray": miou, "miou sray, novel view": miou - 0.1, "frames_damaged": 0.0}
    metrics |= {"ece": 0.1 + 0.01 * number, "frames_scored": 12.0}
    methods = "own image alone", "points of the map", "sray"
    rows = [ClassRow(method, f"class {n}", 0.5) for method in methods for n in range(fleet_report.MAX_CLASSES + 5)]
    segments = [msgspec.structs.replace(segment, method="sray") for segment in found.segments]
    findings = msgspec.structs.replace(found, metrics=metrics, classes=tuple(rows), segments=tuple(segments))
    return msgspec.structs.replace(result, findings=findings)


def test_report_of_eval_is_about_the_method_of_miou_and_says_what_it_leaves_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    histograms: list[str] = []
    classes: list[str] = []

    def draw_histograms(drawn: list[Histogram]) -> UInt8:
        histograms.extend(histogram.title for histogram in drawn)
        return plots.draw_histograms(drawn)

    def draw_boxes(title: str, boxes: list[PercentileBox], x_label: str) -> UInt8:
        classes.extend(box.name for box in boxes if box.name.startswith("class "))
        return plots.draw_boxes(title, boxes, x_label)

    monkeypatch.setattr(fleet_report, "draw_histograms", draw_histograms)
    monkeypatch.setattr(fleet_report, "draw_boxes", draw_boxes)
    store = store_of(tmp_path / "store", [evaluated(n) for n in range(4)])
    page = fleet_report.write_fleet_report(store, tmp_path / "page")
    assert {"miou", "miou sray, novel view", "ece"} <= set(histograms)
    assert not {"miou sray", "frames_damaged", "frames_scored"} & set(histograms)
    assert len(classes) == len(set(classes)) == fleet_report.MAX_CLASSES
    lines = [p.text or "" for p in read_page(page).iter("p")]
    assert any("40 of 45 classes" in line for line in lines)
    assert any("Method sray" in line and "own image alone; points of the map" in line for line in lines)
    assert any("frames_damaged 0, frames_scored 12" in line for line in lines)
    assert any("miou sray (miou)" in line for line in lines)
    assert "miou_sray" not in page.read_text(encoding="utf-8")


def test_worst_logs_of_eval_have_the_pictures_of_replay(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [evaluated(n) for n in range(3)])
    alone = fleet_report.write_fleet_report(store, tmp_path / "alone").read_text(encoding="utf-8")
    assert "data:image/jpeg" not in alone
    for number in range(3):
        store.commit(with_files(store, made_up(number)))
    both = fleet_report.write_fleet_report(store, tmp_path / "both").read_text(encoding="utf-8")
    assert both.count("data:image/jpeg") == 6 and "Pictures are of replay with the same weights." in both


def test_an_exchanged_picture_is_not_shown(tmp_path: Path) -> None:
    store = store_of(tmp_path / "store", [])
    made = [with_files(store, made_up(number)) for number in range(2)]
    for result in made:
        assert store.commit(result)
    store.write(f"{made[0].folder}/overview.png", store.read(f"{made[1].folder}/overview.png"))
    page = fleet_report.write_fleet_report(store, tmp_path / "page").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") == 1


def test_worst_logs_are_those_with_most_of_a_metric_of_which_less_is_better(tmp_path: Path) -> None:
    results = []
    for number in range(3):
        result = made_up(number, operation="finetune")
        findings = msgspec.structs.replace(
            result.findings, metrics={"best_step": 3.0 - number, "held_out_loss": 0.1 * (number + 1)}
        )
        results.append(msgspec.structs.replace(result, findings=findings))
    path = fleet_report.write_fleet_report(store_of(tmp_path / "store", results), tmp_path / "page")
    page = read_page(path)
    assert "finetune: worst logs by held_out_loss (lower is better)" in [head.text for head in page.iter("h2")]
    assert [name for name in cells(page) if name.startswith("/logs/")] == [r.log for r in reversed(results)]


def test_files_outside_the_store_are_no_links(tmp_path: Path) -> None:
    result = made_up(0)
    findings = msgspec.structs.replace(result.findings, report="../../../outside.html", thumbnail="/etc/passwd")
    store = store_of(tmp_path / "store", [msgspec.structs.replace(result, findings=findings)])
    assert run("fleet", "report", store.url, "--out", tmp_path / "page").returncode == 0
    text = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert "outside.html" not in text and "<a href" not in text


def test_compare_finds_a_worse_version_and_not_a_rerun(tmp_path: Path) -> None:
    results = [made_up(n) for n in range(6)]
    a, same = store_of(tmp_path / "a", results), store_of(tmp_path / "same", results)
    worse = store_of(tmp_path / "worse", [made_up(n, loss=0.15) for n in range(6)])
    done = run("fleet", "compare", a.url, same.url)
    assert done.returncode == 0 and done.stdout.rstrip().endswith("not worse"), done.stderr
    assert "replay, miou (higher is better)" in done.stdout
    done = run("fleet", "compare", a.url, worse.url, "--json")
    found = json.loads(done.stdout)
    assert done.returncode == 1 and found["worse"] and len(found["logs"]) == 6
    assert found["overall"]["high"] < 0
    done = run("fleet", "compare", a.url, worse.url)
    assert done.returncode == 1 and "6 logs lost more than 0.02" in done.stdout


@pytest.mark.parametrize(("verb", "usage"), [("compare", "{STORE_A} [STORE_B]"), ("table", "{STORE} [SQL]")])
def test_usage_shows_which_arguments_may_be_left_out(verb: str, usage: str) -> None:
    assert f"{usage}\n" in run("fleet", verb, "--help").stdout


def test_compare_within_a_store(store: Store) -> None:
    done = run("fleet", "compare", store.url, "--a", "version=0.1.0", "--b", "version=0.2.0")
    assert done.returncode == 1 and "the mean of miou over logs is worse" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "STORE_B"),
        (("{store}", "--a", "version"), "--a version: write NAME=VALUE"),
        (("{store}", "--metric", "moiu"), "moiu"),
        (("{store}", "--method", "srey"), "no result has the method 'srey'; there are: replay"),
        (("{store}", "--metric", "ate_m"), "ate_m: it is not known whether more or less"),
        (("{store}", "--cost", "seconds=much"), "write a fraction"),
        (("{store}", "--threshold", "-1"), "--threshold"),
        (("{store}/none",), "is no fleet store"),
    ],
)
def test_wrong_usage_of_compare_exits_with_2(store: Store, arguments: tuple[str, ...], said: str) -> None:
    done = run("fleet", "compare", store.url, *(word.format(store=store.url) for word in arguments))
    assert done.returncode == 2 and said in done.stderr and not done.stdout


def test_a_remote_store_is_reported_and_compared(tmp_path: Path) -> None:
    store = Store("memory://fleet-verbs", create=True)
    for number in range(3):
        store.commit(with_files(store, made_up(number)))
    done = run("fleet", "report", store.url, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    page = read_page(tmp_path / "report.html")  # without links: a bucket has no pages that a browser opens
    assert len(pictures(page)) >= 3 + 2
    assert run("fleet", "compare", store.url, store.url).returncode == 0
