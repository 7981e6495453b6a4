from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.inputs import find_inputs


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    for name in ("b.mcap", "a.mcap", "notes.txt", "run/x.mcap", "run/x-1.mcap", "run2/y.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"log")
    return tmp_path


def test_a_glob_takes_logs_only_in_order(logs: Path) -> None:
    assert [Path(i.url).name for i in find_inputs([f"{logs}/*"], ".mcap")] == ["a.mcap", "b.mcap"]


def test_a_glob_with_a_slash_takes_folders(logs: Path) -> None:
    assert [Path(i.url).name for i in find_inputs([f"{logs}/*/"], ".mcap")] == ["run", "run2"]


def test_a_name_with_letters_of_globs_is_a_name(logs: Path) -> None:
    (logs / "a[1].mcap").write_bytes(b"log")
    assert [Path(i.url).name for i in find_inputs([f"{logs}/a[1].mcap"], ".mcap")] == ["a[1].mcap"]


def test_a_signed_url_is_no_glob() -> None:
    (found,) = find_inputs(["https://host/a.mcap?X-Amz-Signature=1"], ".mcap")
    assert found.url == "https://host/a.mcap?X-Amz-Signature=1"


def test_a_log_that_is_named_twice_is_taken_once(logs: Path) -> None:
    assert len(find_inputs([f"{logs}/a.mcap", f"{logs}/*.mcap"], ".mcap")) == 2


def test_a_manifest_gives_tags_and_counts_from_its_own_folder(logs: Path) -> None:
    (logs / "fleet.csv").write_text("log,robot,site\na.mcap,r1,north\nrun,r2,\n", encoding="utf-8")
    first, second = find_inputs([str(logs / "fleet.csv")], ".mcap")
    assert first.url == str(logs / "a.mcap") and first.tags == {"robot": "r1", "site": "north"}
    assert second.url == str(logs / "run") and second.tags == {"robot": "r2"}


def test_tags_of_a_manifest_go_before_a_plain_name(logs: Path) -> None:
    (logs / "fleet.csv").write_text("log,robot\na.mcap,r1\n", encoding="utf-8")
    found = find_inputs([f"{logs}/a.mcap", str(logs / "fleet.csv")], ".mcap")
    assert [item.tags for item in found] == [{"robot": "r1"}]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("path,robot\na.mcap,r1\n", "no column 'log'"),
        ("log,robot\n,r1\n", "line 2 names no log"),
        ("log,robot\na.mcap\n", "another number of columns"),
        ("log,robot\n", "no logs are given"),
        ("", "no column 'log'"),
    ],
)
def test_a_manifest_that_cannot_be_used_says_why(logs: Path, text: str, why: str) -> None:
    (logs / "fleet.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=why):
        find_inputs([str(logs / "fleet.csv")], ".mcap")


def test_other_tags_for_the_same_log_are_refused(logs: Path) -> None:
    (logs / "fleet.csv").write_text("log,robot\na.mcap,r1\na.mcap,r2\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="twice"):
        find_inputs([str(logs / "fleet.csv")], ".mcap")


@pytest.mark.parametrize(
    ("name", "why"), [("c.mcap", "no such log"), ("c*.mcap", "matches no file"), ("c*/", "folder")]
)
def test_nothing_there_is_an_error(logs: Path, name: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        find_inputs([f"{logs}/{name}"], ".mcap")
