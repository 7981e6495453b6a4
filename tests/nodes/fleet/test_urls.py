"""Paths and URLs: what opens them, and that no message shows what lets anybody in."""

from __future__ import annotations

from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError, FleetError, StoreError
from semantic_mapper.nodes.fleet.urls import is_url, open_url, reaching, shown

SECRET = "wJalrXUtnFEMI/K7MDENG/bPxRfiCYEXAMPLEKEY"


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("s3://bucket/logs/room.mcap", "s3://bucket/logs/room.mcap"),
        ("s3://bucket/a:b@c", "s3://bucket/a:b@c"),
        (f"s3://AKIA:{SECRET}@bucket/room.mcap", "s3://bucket/room.mcap"),
        ("https://token@host/room.mcap", "https://host/room.mcap"),
        ("https://host:8080/a@b.mcap", "https://host:8080/a@b.mcap"),
        ("https://b.s3.amazonaws.com/r.mcap?X-Amz-Signature=abc", "https://b.s3.amazonaws.com/r.mcap?..."),
        ("gs://bucket/r.mcap#1234", "gs://bucket/r.mcap?..."),
        ("abfs://container@account.dfs.core.windows.net/r", "abfs://container@account.dfs.core.windows.net/r"),
        ("sftp://robot:pw@host/r", "sftp://host/r"),
        ("simplecache::s3://k:s@bucket/r?x=1", "simplecache::s3://bucket/r?..."),
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
        open_url(url)
    assert SECRET[:13] not in str(refused.value)


def test_paths_become_absolute_and_unknown_schemes_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
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
    assert SECRET not in str(caught.value) and "abc" not in str(caught.value) and "sig" not in str(caught.value)
