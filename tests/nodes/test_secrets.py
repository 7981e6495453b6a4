"""What people type, with a secret in it, comes back without: in errors, tables, JSON, logs and files."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import structlog
from rich.table import Table

from semantic_mapper.files import write_json
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.process import prepare_process
from semantic_mapper.replay.page import Section, table_of, write_page
from tests.nodes.support import run_here

SECRET = "wJalrXUtnFEMIbPxRfiCYEXAMPLEKEY"
FORMS = (
    f"filecache::s3://KEY:{SECRET}@bucket/x",
    f"s3:/KEY:{SECRET}@bucket/x",
    f"s3:KEY:{SECRET}@bucket",
    f"no/such.mcap;token={SECRET}",
    f"KEY:{SECRET}@bucket/x.mcap",
)


@pytest.mark.parametrize(
    "words",
    [
        ("query", "{}", "info"),
        ("query", "{}", "info", "--json"),
        ("fleet", "table", "{}"),
        ("fleet", "compare", "{}", "{}"),
        ("fleet", "run", "replay", "{}", "--out", "store"),
        ("fleet", "merge", "{}", "a.npz", "--out", "store.npz"),
        ("replay", "{}", "--out", "out"),
        ("import", "{}", "a.mcap"),
        ("info", "{}"),
        ("view", "{}"),
        ("export", "{}", "--out", "a.rrd"),
        ("eval", "{}"),
        ("up", "{}"),
        ("up", "replay", "--set", "camera.log={}", "--set", "camera.mode={}"),
        ("record", "a.mcap", "--launch", "{}"),
    ],
)
def test_no_verb_shows_the_secret_of_an_address(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for url in FORMS if words[:2] in (("query", "{}"), ("fleet", "table")) else FORMS[1:3]:
        code, said = run_here(*(word.replace("{}", url) for word in words))
        assert code in (1, 2) and said
        assert SECRET not in said, said


def test_tables_json_reports_files_and_logs_are_without_secrets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url, stream = f"s3://KEY:{SECRET}@bucket/x", io.StringIO()
    output = Output(stream)
    table = Table(url, title=url)
    table.add_row(url)
    output.print(url, table)
    output.quiet = True
    output.json({"map": url, "logs": [url]})
    write_json(tmp_path / "summary.json", {"source": url})
    write_page(tmp_path / "page.html", url, [Section(url, [url], tables=[table_of((url,), [(url,)])])])
    prepare_process()
    structlog.get_logger("test").error("failed", error=url, places=[url], path=Path(url))
    structlog.reset_defaults()
    written = stream.getvalue() + "".join(path.read_text() for path in tmp_path.iterdir()) + capsys.readouterr().err
    assert written.count("s3://bucket/x") >= 10
    assert "KEY" not in written
    assert json.loads((tmp_path / "summary.json").read_text()) == {"source": "s3://bucket/x"}


def test_the_address_of_a_page_of_this_machine_is_shown_whole() -> None:
    stream = io.StringIO()
    Output(stream).address("watch at", "http://127.0.0.1:9090/?url=x&token=mine")
    assert stream.getvalue() == "watch at http://127.0.0.1:9090/?url=x&token=mine\n"
