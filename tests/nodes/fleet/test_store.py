"""Stores in folders and buckets: one result counts, whole or not at all."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from fsspec.config import conf, set_conf_env
from moto.server import ThreadedMotoServer

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet.inputs import find_inputs
from semantic_mapper.nodes.fleet.store import Store, encode_document, is_store
from semantic_mapper.nodes.fleet.table import Tables
from tests.nodes.fleet.made_up import failure_of, made_up, store_of

RESULT = made_up(1)
OTHER = made_up(1, folder=f"files/{RESULT.key}/two")
BUCKET = "s3://results/fleet"


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    moto = ThreadedMotoServer(port=0)
    moto.start()
    host, port = moto.get_host_and_port()
    yield f"http://{host}:{port}"
    moto.stop()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL for a store in an empty bucket."""
    for name, value in (
        ("AWS_ACCESS_KEY_ID", "name"),
        ("AWS_SECRET_ACCESS_KEY", "secret-of-the-test"),
        ("FSSPEC_S3_ENDPOINT_URL", server),
    ):
        monkeypatch.setenv(name, value)
    set_conf_env(conf)
    files = fsspec.get_filesystem_class("s3")
    files.clear_instance_cache()
    fsspec.filesystem("s3").mkdir("results")
    yield BUCKET
    fsspec.filesystem("s3").rm("results", recursive=True)
    conf.pop("s3", None)
    files.clear_instance_cache()


@pytest.fixture(params=["folder", "bucket"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return request.getfixturevalue("bucket") if request.param == "bucket" else str(tmp_path / "a b [1]*? ü")


def test_results_failures_and_files_come_back(url: str, tmp_path: Path) -> None:
    store = store_of(url, [RESULT, made_up(2)])
    assert is_store(url) and not is_store(f"{url}/files")
    again = Store(url)
    assert again.result(RESULT.key) == RESULT and again.result("0" * 40) is None
    assert sorted(result.log for result in again.results()) == ["/logs/0001.mcap", "/logs/0002.mcap"]
    failure = failure_of(RESULT)
    store.write(f"failures/{failure.key}.json", encode_document(failure))
    assert list(again.failures()) == [failure]
    store.remove(f"failures/{failure.key}.json")
    assert list(again.failures()) == []
    (tmp_path / "map").write_bytes(b"map")
    store.upload(tmp_path / "map", f"{RESULT.folder}/maps/a.npz")
    again.download(f"{RESULT.folder}/maps/a.npz", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == b"map"
    with pytest.raises(StoreError, match=r"no\.npz: is missing"):
        again.download("no.npz", tmp_path / "copy")
    assert Tables(again).query("count(*)").values == [(2,)]


def test_the_first_commit_counts_and_files_of_the_second_go(url: str) -> None:
    store = store_of(url)
    for result in (RESULT, OTHER):
        store.write(f"{result.folder}/map.npz", b"map")
    assert store.commit(RESULT) and not store.commit(OTHER)
    assert store.commit(RESULT), "its answer was lost"
    assert store.result(RESULT.key) == RESULT
    assert store.exists(f"{RESULT.folder}/map.npz") and not store.exists(f"{OTHER.folder}/map.npz")


def test_of_many_writers_at_once_one_commits(url: str) -> None:
    store_of(url)
    made: list[bool] = []

    def commit(number: int) -> None:
        made.append(Store(url).commit(made_up(1, folder=f"files/{RESULT.key}/{number}")))

    threads = [threading.Thread(target=commit, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(made) == 1 and len(made) == 8


def test_what_killed_attempts_have_left_goes_with_the_next_result(tmp_path: Path) -> None:
    store = store_of(tmp_path)
    store.write(f"files/{RESULT.key}/killed/map.npz", b"half")
    store.write(f"{RESULT.folder}/map.npz", b"map")
    assert store.commit(RESULT) and store.names(f"files/{RESULT.key}") == ["one"]


def test_a_damaged_or_exchanged_result_is_named(tmp_path: Path) -> None:
    store = store_of(tmp_path, [RESULT])
    store.write("results/x.json", store.find(f"results/{RESULT.key}.json") or b"")
    with pytest.raises(ConfigError, match=rf"x\.json: is the result of another task \({RESULT.key}"):
        store.result("x")
    store.write("results/x.json", b"{")
    with pytest.raises(ConfigError, match=r"x\.json: is damaged .*delete it, and `fleet run` does the task again"):
        list(store.results())


def test_tasks_in_other_folders_find_a_store_of_a_relative_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    store = store_of("runs/fleet", [RESULT])
    monkeypatch.chdir("/")
    assert Store(store.url).result(RESULT.key) == RESULT and store.shown == "runs/fleet"


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no fleet store"):
        Store(str(tmp_path))
    with pytest.raises(ConfigError, match="cannot have a query"):
        Store("memory://bucket/fleet?X-Amz-Signature=abc", create=True)
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    for place in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises((ConfigError, StoreError), match=r"choose another --out|is refused"):
            Store(str(place), create=True)
    (tmp_path / "fleet.json").write_text('{"format": "semantic-mapper-fleet", "version": 99}', encoding="utf-8")
    with pytest.raises(ConfigError, match="damaged or of another version"):
        Store(str(tmp_path))


def test_a_manifest_and_globs_are_read_from_a_bucket(bucket: str) -> None:
    files = fsspec.filesystem("s3")
    files.pipe_file("results/fleet.csv", b"log,robot\nsite/a.mcap,r1\n")
    for name in "ab":
        files.pipe_file(f"results/site/{name}.mcap", b"a")
    (tagged,) = find_inputs(["s3://results/fleet.csv"], ".mcap")
    assert (tagged.url, tagged.tags) == ("s3://results/site/a.mcap", {"robot": "r1"})
    found = find_inputs(["s3://results/site/*.mcap"], ".mcap")
    assert [item.url for item in found] == ["s3://results/site/a.mcap", "s3://results/site/b.mcap"]


def test_a_store_that_cannot_be_reached_is_one_clear_error(bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StoreError, match="s3://no-such-bucket/fleet") as caught:
        Store("s3://no-such-bucket/fleet", create=True)
    assert "secret-of-the-test" not in str(caught.value)
