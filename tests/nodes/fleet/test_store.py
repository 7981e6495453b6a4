"""Stores in folders and elsewhere: one result counts, whole or not at all."""

from __future__ import annotations

from pathlib import Path
from uuid import uuid4

import fsspec
import pytest

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet.results import Tables
from semantic_mapper.nodes.fleet.store import Store, find_inputs, is_store
from tests.nodes.fleet.made_up import failure_of, made_up, store_of

RESULT = made_up(1)
OTHER = made_up(1, folder=f"files/{RESULT.key}/two")


@pytest.fixture(params=["folder", "memory"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"memory://{uuid4()}/fleet" if request.param == "memory" else str(tmp_path / "a b [1]*? ü")


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


def test_a_manifest_and_globs_are_read_from_elsewhere() -> None:
    files, place = fsspec.filesystem("memory"), str(uuid4())
    files.pipe_file(f"/{place}/fleet.csv", b"log,robot\nsite/a.mcap,r1\n")
    for name in "ab":
        files.pipe_file(f"/{place}/site/{name}.mcap", b"a")
    (tagged,) = find_inputs([f"memory://{place}/fleet.csv"], ".mcap")
    assert (tagged.url, tagged.tags) == (f"memory://{place}/site/a.mcap", {"robot": "r1"})
    found = find_inputs([f"memory://{place}/site/*.mcap"], ".mcap")
    assert [item.url.removeprefix(f"memory:///{place}/") for item in found] == ["site/a.mcap", "site/b.mcap"]


def test_a_store_is_found_from_elsewhere_and_names_damaged_results(
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
