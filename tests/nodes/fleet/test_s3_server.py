"""What the S3 server of the tests does, and how fsspec finds it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from tests.nodes.fleet.s3_server import ACCESS_KEY, SECRET_KEY, FaultPlan, S3Server, failing_s3_server, s3_server

READING = """
import fsspec
with fsspec.open("s3://logs/room.txt") as file:
    print(file.read().decode())
"""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[S3Server]:
    (tmp_path / "served" / "logs").mkdir(parents=True)
    (tmp_path / "served" / "logs" / "room.txt").write_text("a log")
    with s3_server(tmp_path / "served") as server:
        yield server


def read_in_another_process(home: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    hidden = ("AWS_", "FSSPEC_")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(hidden)}
    environment |= {"HOME": str(home), "AWS_EC2_METADATA_DISABLED": "true", **variables}
    return subprocess.run([sys.executable, "-c", READING], env=environment, capture_output=True, text=True, timeout=120)


def test_objects_are_written_listed_and_read(served: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    served.use(monkeypatch)
    files = fsspec.filesystem("s3", use_listings_cache=False)
    files.pipe_file("logs/a/one", b"first")
    assert files.cat_file("logs/a/one") == b"first"
    assert files.cat_file("logs/a/one", start=1, end=3) == b"ir"
    assert files.find("logs") == ["logs/a/one", "logs/room.txt"]
    files.rm_file("logs/a/one")
    assert not files.exists("logs/a/one")


def test_an_object_is_created_once(served: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    served.use(monkeypatch)
    files = fsspec.filesystem("s3", use_listings_cache=False)
    files.pipe_file("logs/one", b"first", mode="create")
    with pytest.raises(FileExistsError):
        files.pipe_file("logs/one", b"second", mode="create")
    assert files.cat_file("logs/one") == b"first"


@pytest.mark.slow
def test_faults_come_as_planned_and_clients_get_over_them(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = []
    for _ in range(2):
        with failing_s3_server(FaultPlan(seed=1, error=0.1, slow=0.1, cut=0.1, lost=0.1), "logs") as server:
            server.use(monkeypatch)
            files = fsspec.filesystem("s3", use_listings_cache=False)
            for index in range(20):
                files.pipe_file(f"logs/{index}", bytes([index]) * 1000)
                assert files.cat_file(f"logs/{index}") == bytes([index]) * 1000
        assert set(server.counts) == {"passed", "error", "slow", "cut", "lost"}
        counts.append(server.counts)
    assert counts[0] == counts[1]


@pytest.mark.slow
def test_credentials_come_from_the_environment_or_a_file(served: S3Server, tmp_path: Path) -> None:
    assert read_in_another_process(tmp_path, **served.environment).stdout == "a log\n"

    endpoint = {"FSSPEC_S3_ENDPOINT_URL": served.url}
    (tmp_path / ".aws").mkdir()
    keys = f"[default]\naws_access_key_id = {ACCESS_KEY}\naws_secret_access_key = {SECRET_KEY}\n"
    (tmp_path / ".aws" / "credentials").write_text(keys)
    assert read_in_another_process(tmp_path, **endpoint).stdout == "a log\n"
    (tmp_path / ".aws" / "credentials").unlink()

    (tmp_path / "fsspec").mkdir()
    settings = f"[s3]\nkey = {ACCESS_KEY}\nsecret = {SECRET_KEY}\nendpoint_url = {served.url}\n"
    (tmp_path / "fsspec" / "conf.ini").write_text(settings)
    assert read_in_another_process(tmp_path, FSSPEC_CONFIG_DIR=str(tmp_path / "fsspec")).stdout == "a log\n"

    refused = read_in_another_process(tmp_path, **{**served.environment, "AWS_SECRET_ACCESS_KEY": "wrong"})
    assert refused.returncode != 0
    assert "PermissionError" in refused.stderr or "Forbidden" in refused.stderr
