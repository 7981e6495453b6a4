from __future__ import annotations

import pytest

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet import urls
from semantic_mapper.nodes.fleet.urls import is_url, persistently, shown, split_url


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(urls.time, "sleep", lambda seconds: None)


def test_a_path_is_no_url() -> None:
    assert not is_url("logs/a.mcap") and not is_url("/logs/a:b.mcap")
    assert is_url("s3://bucket/a.mcap") and is_url("file:///a.mcap")


def test_relative_paths_become_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    assert split_url("a/b")[1] == str(tmp_path / "a" / "b")
    assert split_url(f"file://{tmp_path}/a")[1] == str(tmp_path / "a")


@pytest.mark.parametrize("url", ["s3://key:secret@bucket/x", "https://user:secret@host/x", "s3://secret@bucket/x"])
def test_credentials_in_a_url_are_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(ConfigError, match="credentials") as caught:
        split_url(url)
    assert "secret" not in str(caught.value)


def test_signatures_are_not_shown() -> None:
    url = "https://host/a.mcap?X-Amz-Signature=abc123&X-Amz-Credential=me&part=2&token=t0p"
    seen = shown(url)
    assert "abc123" not in seen and "me&" not in seen and "t0p" not in seen
    assert seen.startswith("https://host/a.mcap?") and "part=2" in seen


def test_an_unknown_scheme_is_a_clear_error() -> None:
    with pytest.raises(ConfigError, match="gopher"):
        split_url("gopher://host/x")


def test_what_fails_is_tried_again() -> None:
    calls = []

    def call() -> str:
        calls.append(1)
        if len(calls) < 4:
            raise ConnectionResetError("cut")
        return "done"

    assert persistently(call, "s3://bucket/x") == "done"
    assert len(calls) == 4


def test_what_keeps_failing_ends_with_the_reason() -> None:
    with pytest.raises(StoreError, match=r"s3://bucket/x.*cut"):
        persistently(lambda: (_ for _ in ()).throw(ConnectionResetError("cut")), "s3://bucket/x")


def test_what_is_missing_or_refused_is_not_tried_again() -> None:
    calls = []

    def missing() -> None:
        calls.append(1)
        raise FileNotFoundError("no")

    with pytest.raises(FileNotFoundError):
        persistently(missing, "x")

    def refused() -> None:
        calls.append(1)
        raise PermissionError("forbidden")

    with pytest.raises(StoreError, match="credentials"):
        persistently(refused, "x")
    assert len(calls) == 2
