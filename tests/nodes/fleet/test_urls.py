"""Paths and URLs: what opens them, which logs they mean, and that no message shows what lets anybody in."""

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError, FleetError, StoreError
from semantic_mapper.nodes.fleet.store import find_inputs, is_url, open_url, reaching

SECRET = "wJalrXUtnFEMI/K7MDENG/bPxRfiCYEXAMPLEKEY"


def test_urls_with_keys_are_refused_and_paths_become_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for url in (f"s3://AKIA:{SECRET}@bucket/r", f"https://{SECRET[:13]}@host/r"):
        with pytest.raises(FleetError, match="must not hold a key") as refused:
            open_url(url)
        assert SECRET[:13] not in str(refused.value)
    for url in ("memory://bucket/a:b@c", "https://host:8080/a@b.mcap?X-Amz-Signature=1"):  # only look as if
        assert open_url(url)[1].startswith(("/bucket/a:b@c", "https://host:8080/a@b.mcap"))
    assert not is_url("logs/a.mcap") and not is_url("/logs/a:b.mcap") and is_url("file:///a.mcap")
    monkeypatch.chdir(tmp_path)
    assert open_url("a/b/")[1] == str(tmp_path / "a" / "b")
    assert open_url(f"file://{tmp_path}/a")[1] == str(tmp_path / "a")
    with pytest.raises(ConfigError, match="gopher"):
        open_url("gopher://host/x")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ConnectionResetError(f"cut, url='https://u:{SECRET}@host/a?X-Amz-Signature=abc'"), "cannot be reached"),
        (PermissionError("forbidden"), "who may read and write"),
        (FileNotFoundError("no"), "s3://bucket/x.*is missing"),
    ],
)
def test_errors_of_requests_are_one_of_ours_without_what_signs_their_urls(error: OSError, said: str) -> None:
    with pytest.raises(StoreError, match=said) as caught, reaching("s3://bucket/x?sig=1"):
        raise error
    assert SECRET not in str(caught.value) and "abc" not in str(caught.value) and "sig=1" not in str(caught.value)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    for name in ("b.mcap", "a.mcap", "c[1].mcap", "notes.txt", "run/x.mcap", "run/x-1.mcap", "run2/y.mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"log")
    return tmp_path


def test_names_globs_folders_and_manifests_are_logs_once_each(logs: Path) -> None:
    for names, found in (
        (["*"], ["a.mcap", "b.mcap", "c[1].mcap"]),
        (["*/"], ["run", "run2"]),
        (["c[1].mcap"], ["c[1].mcap"]),
        (["a.mcap", "[ab].mcap"], ["a.mcap", "b.mcap"]),
    ):
        inputs = find_inputs([f"{logs}/{name}" for name in names])
        assert [Path(item.url).name for item in inputs] == found
    (logs / "fleet.csv").write_text("log,robot,site\na.mcap,r1,north\nrun,r2,\n", encoding="utf-8")
    first, second = find_inputs([str(logs / "a.mcap"), str(logs / "fleet.csv")])
    assert first.url == str(logs / "a.mcap") and first.tags == {"robot": "r1", "site": "north"}
    assert second.url == str(logs / "run") and second.tags == {"robot": "r2"}
    (signed,) = find_inputs(["https://host/a.mcap?X-Amz-Signature=1"])
    assert signed.url == "https://host/a.mcap?X-Amz-Signature=1", "no glob"


def test_what_is_no_log_and_a_manifest_that_cannot_be_used_are_refused(logs: Path) -> None:
    for name, why in (("c.mcap", "no such log"), ("d*.mcap", "matches no file"), ("c*/", "matches no directory")):
        with pytest.raises(ConfigError, match=why):
            find_inputs([f"{logs}/{name}"])
    for text, why in (
        ("path,robot\na.mcap,r1\n", "in the column 'log'"),
        ("log,robot\n,r1\n", "line 2 must have a path"),
        ("log,robot\na.mcap\n", "as many columns as the first"),
        ("log,robot\n", "no logs are given"),
        ("log,robot\n\xff,b", "no CSV in UTF-8"),
    ):
        (logs / "fleet.csv").write_text(text, encoding="latin-1")
        with pytest.raises(ConfigError, match=why):
            find_inputs([str(logs / "fleet.csv")])
