from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError, FleetError, StoreError
from semantic_mapper.nodes.fleet import urls
from semantic_mapper.nodes.fleet.urls import is_url, persistently, refuse_credentials, shown, split_url, without_secrets

SECRET = "wJalrXUtnFEMI/K7MDENG/bPxRfiCYEXAMPLEKEY"


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("s3://bucket/logs/room.mcap", "s3://bucket/logs/room.mcap"),
        ("s3://AKIA:plain@bucket/room.mcap", "s3://bucket/room.mcap"),
        (f"s3://AKIA:{SECRET}@bucket/room.mcap", "s3://bucket/room.mcap"),
        ("https://token@host/room.mcap", "https://host/room.mcap"),
        ("https://host:8080/a@b.mcap", "https://host:8080/a@b.mcap"),
        ("https://b.s3.amazonaws.com/r.mcap?X-Amz-Signature=abc", "https://b.s3.amazonaws.com/r.mcap?..."),
        ("gs://bucket/r.mcap#1234", "gs://bucket/r.mcap?..."),
        ("abfs://container@account.dfs.core.windows.net/r", "abfs://container@account.dfs.core.windows.net/r"),
        ("sftp://robot:pw@host/r", "sftp://host/r"),
        ("simplecache::s3://k:s@bucket/r?x=1", "simplecache::s3://bucket/r?..."),
        ("zip://a.mcap::https://u:p@host/x.zip", "zip://a.mcap::https://host/x.zip"),
        ("file:///data/a@b.mcap", "file:///data/a@b.mcap"),
        ("/data/what?/a#b@c.mcap", "/data/what?/a#b@c.mcap"),
        ("runs/a b.mcap", "runs/a b.mcap"),
    ],
)
def test_urls_are_shown_without_credentials(url: str, expected: str) -> None:
    assert shown(url) == expected


@pytest.mark.parametrize(
    "url", [f"s3://AKIA:{SECRET}@bucket/r", f"simplecache::https://u:{SECRET}@host/r", f"https://{SECRET[:13]}@host/r"]
)
def test_a_url_with_a_key_or_token_is_refused_without_showing_it(url: str) -> None:
    with pytest.raises(FleetError, match="must not hold a key") as refused:
        refuse_credentials(url)
    assert SECRET[:13] not in str(refused.value)


@pytest.mark.parametrize("url", ["s3://bucket/a:b@c", "abfs://container@account/r", "https://host:80/a@b", "/a:b@c"])
def test_urls_without_a_key_are_taken_and_shown_whole(url: str) -> None:
    refuse_credentials(url)
    assert shown(url) == url


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(urls.time, "sleep", lambda seconds: None)


def test_a_path_is_no_url() -> None:
    assert not is_url("logs/a.mcap") and not is_url("/logs/a:b.mcap")
    assert is_url("s3://bucket/a.mcap") and is_url("file:///a.mcap")


def test_relative_paths_become_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert split_url("a/b")[1] == str(tmp_path / "a" / "b")
    assert split_url(f"file://{tmp_path}/a")[1] == str(tmp_path / "a")


def test_an_unknown_scheme_is_a_clear_error() -> None:
    with pytest.raises(ConfigError, match="gopher"):
        split_url("gopher://host/x")


@pytest.mark.parametrize(
    "url",
    [
        "http://[",
        "http://127.0.0.1:99999/x",
        "http://[::1]:0x/x",
        "http:///x",
        "http://a..b/x",
        "zip://a::ftp://h:x/a.zip",
    ],
)
def test_an_address_that_cannot_be_is_refused_before_it_is_requested(url: str) -> None:
    with pytest.raises(ConfigError, match=r"write SCHEME://HOST:PORT/PATH"):
        split_url(url)


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


def test_messages_of_other_packages_are_shown_without_what_signs_their_urls() -> None:
    text = "403, url='https://u:p@host/a.mcap?X-Amz-Signature=SECRET' and s3://k:SECRET@bucket/x"
    assert without_secrets(text) == "403, url='https://host/a.mcap?...' and s3://bucket/x"


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

    with pytest.raises(StoreError, match="who may read and write"):
        persistently(refused, "x")
    assert len(calls) == 2
