"""Stores in folders and buckets: one result counts, whole or not at all."""

from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from fsspec.config import conf, set_conf_env
from moto.server import ThreadedMotoServer

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet.results import Tables
from semantic_mapper.nodes.fleet.store import Store, find_inputs, is_store
from tests.nodes.fleet.made_up import failure_of, made_up, store_of

RESULT = made_up(1)
OTHER = made_up(1, folder=f"files/{RESULT.key}/two")
BUCKET = "s3://results/fleet"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """URL for a store in an empty bucket."""
    moto = ThreadedMotoServer(port=0)
    moto.start()
    host, port = moto.get_host_and_port()
    for name, value in (
        ("AWS_ACCESS_KEY_ID", "name"),
        ("AWS_SECRET_ACCESS_KEY", "secret-of-the-test"),
        ("FSSPEC_S3_ENDPOINT_URL", f"http://{host}:{port}"),
    ):
        monkeypatch.setenv(name, value)
    set_conf_env(conf)
    files = fsspec.get_filesystem_class("s3")
    files.clear_instance_cache()
    fsspec.filesystem("s3").mkdir("results")
    yield BUCKET
    fsspec.filesystem("s3").rm("results", recursive=True)
    moto.stop()
    conf.pop("s3", None)
    files.clear_instance_cache()


@pytest.fixture(params=["folder", "bucket"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return request.getfixturevalue("bucket") if request.param == "bucket" else str(tmp_path / "a b [1]*? ü")


def test_results_failures_and_files_come_back_and_the_first_commit_counts(url: str, tmp_path: Path) -> None:
    store = store_of(url, [RESULT, made_up(2)])
    assert is_store(url) and not is_store(f"{url}/files")
    again = Store(url)
    assert RESULT in again.results()
    assert sorted(result.log for result in again.results()) == ["/logs/0001.mcap", "/logs/0002.mcap"]
    failure = failure_of(RESULT)
    store.note_failure(failure)
    assert list(again.failures()) == [failure]
    store.remove(f"failures/{failure.key}.json")
    assert list(again.failures()) == []
    (tmp_path / "map").write_bytes(b"map")
    for result in (RESULT, OTHER):
        store.upload(tmp_path / "map", f"{result.folder}/maps/a.npz")
    assert not store.commit(OTHER) and OTHER not in store.results()
    assert again.find(f"{RESULT.folder}/maps/a.npz") == b"map" and again.find(f"{OTHER.folder}/maps/a.npz") is None
    assert Tables(again).query("count(*)").values == [(2,)]


def test_a_manifest_and_globs_are_read_from_a_bucket(bucket: str) -> None:
    files = fsspec.filesystem("s3")
    files.pipe_file("results/fleet.csv", b"log,robot\nsite/a.mcap,r1\n")
    for name in "ab":
        files.pipe_file(f"results/site/{name}.mcap", b"a")
    (tagged,) = find_inputs(["s3://results/fleet.csv"])
    assert (tagged.url, tagged.tags) == ("s3://results/site/a.mcap", {"robot": "r1"})
    found = find_inputs(["s3://results/site/*.mcap"])
    assert [item.url for item in found] == ["s3://results/site/a.mcap", "s3://results/site/b.mcap"]
    with pytest.raises(StoreError, match="s3://no-such-bucket/fleet") as caught:
        Store("s3://no-such-bucket/fleet", create=True)
    assert "secret-of-the-test" not in str(caught.value)


def test_a_store_of_a_relative_path_is_found_from_elsewhere_and_names_a_damaged_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    store = store_of("runs/fleet", [RESULT])
    monkeypatch.chdir("/")
    assert list(Store(store.url).results()) == [RESULT] and store.shown == "runs/fleet"
    store.write("results/x.json", b"{")
    with pytest.raises(ConfigError, match=r"x\.json: is damaged .*delete it, and `fleet run` does the task again"):
        list(store.results())


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no fleet store"):
        Store(str(tmp_path))
    with pytest.raises(ConfigError, match="cannot have a query"):
        Store("memory://bucket/fleet?X-Amz-Signature=abc", create=True)
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    for place in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises((ConfigError, StoreError), match=r"choose another --out|cannot be reached"):
            Store(str(place), create=True)
    (tmp_path / "fleet.json").write_text('{"format": "semantic-mapper-fleet", "version": 99}', encoding="utf-8")
    with pytest.raises(ConfigError, match="no fleet store of this version"):
        Store(str(tmp_path))
