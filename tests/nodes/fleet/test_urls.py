from __future__ import annotations

import pytest

from semantic_mapper.errors import FleetError
from semantic_mapper.nodes.fleet.urls import refuse_credentials, shown

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


@pytest.mark.parametrize("url", [f"s3://AKIA:{SECRET}@bucket/r", "simplecache::https://u:pw@host/r"])
def test_a_url_with_a_password_is_refused_without_showing_it(url: str) -> None:
    with pytest.raises(FleetError, match="must not hold a key") as refused:
        refuse_credentials(url)
    assert SECRET not in str(refused.value)
    assert "pw" not in str(refused.value).replace("password", "")


@pytest.mark.parametrize("url", ["s3://bucket/a:b@c", "abfs://container@account/r", "https://host:80/a@b", "/a:b@c"])
def test_other_urls_are_taken(url: str) -> None:
    refuse_credentials(url)
