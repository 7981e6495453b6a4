from __future__ import annotations

import hashlib
import threading
from pathlib import Path

import pytest
from msgspec.structs import replace

from semantic_mapper.errors import ConfigError, StoreError
from semantic_mapper.nodes.fleet.results import Failure, ResultFile, decode_result, encode_document, without_costs
from semantic_mapper.nodes.fleet.store import Store, check_result_file, open_store
from tests.nodes.fleet.documents import made_result


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(str(tmp_path / "store"), create=True)


def test_letters_of_patterns_in_its_path_are_letters(tmp_path: Path) -> None:
    (tmp_path / "a b 1").mkdir()
    store = Store(str(tmp_path / "a b [1]*? ü"), create=True)
    store.write("failed/x.json", b"{}")
    assert store.commit(made_result("k"))
    assert [result.key for result in store.results()] == ["k"]
    assert list(store.read_many(["failed/x.json", "failed/y.json"])) == [("failed/x.json", b"{}")]
    assert (store.keys(), store.names("failed")) == (["k"], ["x.json"])
    store.remove("failed/x.json")
    store.remove("results", folder=True)
    assert store.keys() == [] and store.names("failed") == []


def test_tasks_in_other_folders_find_a_store_of_a_relative_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    store = Store("runs/fleet", create=True)
    store.write("failed/x.json", b"{}")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert open_store(store.url).names("failed") == ["x.json"] and store.shown == "runs/fleet"


def test_a_machine_without_the_drivers_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"is no fleet store.* --out must be a bucket"):
        open_store(str(tmp_path / "not here"))


def test_a_store_has_no_signed_url() -> None:
    with pytest.raises(ConfigError, match="cannot have a query"):
        Store("memory://bucket/fleet?X-Amz-Signature=abc", create=True)


def test_a_folder_with_something_else_does_not_become_a_store(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match="choose another --out"):
        Store(str(tmp_path), create=True)
    with pytest.raises(ConfigError, match="choose another --out"):
        Store(str(tmp_path / "notes.txt"), create=True)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no fleet store"):
        Store(str(tmp_path))
    (tmp_path / "fleet.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ConfigError, match="damaged or of something else"):
        Store(str(tmp_path), create=True)
    (tmp_path / "fleet.json").write_text('{"format": "semantic-mapper-fleet", "version": 99}', encoding="utf-8")
    with pytest.raises(ConfigError, match="upgrade"):
        Store(str(tmp_path))


def test_a_document_comes_back_as_it_was(store: Store) -> None:
    result = made_result("k", tags={"robot": "r1"}, settings={"max_frames": 3})
    assert store.commit(result)
    assert store.result("k") == result == decode_result(encode_document(result), "here")
    assert store.result("other") is None


def test_the_first_commit_counts_and_files_of_the_second_go(store: Store) -> None:
    for attempt in ("one", "two"):
        store.write(f"results/k/{attempt}/map.npz", attempt.encode())
    assert store.commit(made_result("k", "one"))
    assert not store.commit(made_result("k", "two"))
    found = store.result("k")
    assert found is not None and found.folder == "results/k/one"
    assert store.read("results/k/one/map.npz") == b"one"
    assert not store.exists("results/k/two/map.npz")


def test_a_commit_whose_answer_was_lost_counts(store: Store) -> None:
    result = made_result("k", "one")
    store.write("results/k/one/map.npz", b"one")
    assert store.commit(result) and store.commit(result)
    assert store.exists("results/k/one/map.npz")


def test_what_killed_attempts_have_left_goes_with_the_next_result(store: Store) -> None:
    store.write("results/k/killed/map.npz", b"half")
    store.write("results/k/one/map.npz", b"one")
    assert store.commit(made_result("k", "one"))
    assert store.names("results/k") == ["one", "result.json"]


def test_of_many_writers_at_once_one_commits(store: Store) -> None:
    barrier = threading.Barrier(16)
    made: list[bool] = []

    def commit(number: int) -> None:
        barrier.wait()
        made.append(store.commit(made_result("k", f"attempt{number}")))

    threads = [threading.Thread(target=commit, args=(n,)) for n in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(made) == 1


def test_unfinished_attempts_are_no_results(store: Store) -> None:
    store.write("results/begun/one/map.npz", b"half")
    store.commit(made_result("k"))
    assert [result.key for result in store.results()] == ["k"]


def test_drafts_of_killed_writers_are_not_seen(store: Store) -> None:
    assert store.local is not None
    store.write("failed/a.json", b"{}")
    (store.local / "failed" / ".a.json.0123456789ab.part").write_bytes(b"half")
    assert store.names("failed") == ["a.json"]


def test_a_damaged_result_says_what_to_do(store: Store) -> None:
    store.write("results/k/result.json", b"{")
    with pytest.raises(ConfigError, match="delete it"):
        store.result("k")


def test_a_result_of_another_task_is_refused(store: Store) -> None:
    for changed in ({}, {"key": "other"}):
        data = encode_document(replace(made_result("k"), **changed))
        store.write("results/other/result.json", data)
        with pytest.raises(ConfigError, match=r"results/other/result.json: is the result of another task .*delete it"):
            store.result("other")
        with pytest.raises(ConfigError, match="another task"):
            list(store.results())


def test_an_exchanged_file_of_a_result_is_refused(store: Store) -> None:
    key, good, bad = "a" * 40, b"right", b"wrong"
    files = {"map.npz": ResultFile(len(good), hashlib.sha256(good).hexdigest())}
    made = made_result(key, files=files)
    store.write(f"{made.folder}/map.npz", good)
    with pytest.raises(StoreError, match="its result is missing"):
        store.read_result_file(made.folder, "map.npz")
    store.commit(made)
    url = f"{store.url}/{made.folder}/map.npz"
    assert store.read_result_file(made.folder, "map.npz") == good
    check_result_file(url, files["map.npz"].sha256)
    check_result_file("/logs/results/kitchen/run/map.npz", "of a file of no store")
    store.write(f"{made.folder}/map.npz", bad)
    with pytest.raises(StoreError, match="is damaged, or not the file"):
        store.read_result_file(made.folder, "map.npz")
    for other in (url, url.replace("/one/", "/two/")):
        with pytest.raises(StoreError, match="is damaged, or not the file"):
            check_result_file(other, hashlib.sha256(bad).hexdigest())


def test_quarantine_can_be_left_again(store: Store) -> None:
    failure = Failure("k", "replay", "/logs/k.mcap", {}, "0.1.0", ("first", "second"), 1)
    store.quarantine(failure)
    assert list(store.failures()) == [failure]
    store.release("k")
    store.release("k")
    assert not list(store.failures())


def test_what_is_missing_is_a_clear_error(store: Store) -> None:
    with pytest.raises(StoreError, match=r"store/nothing: is missing"):
        store.read("nothing")


def test_costs_are_left_out_of_comparisons() -> None:
    one = made_result("k", "one", node="a", seconds=1.0)
    other = made_result("k", "two", node="b", seconds=9.0, attempts=2, finished_ns=5)
    assert without_costs(one) == without_costs(other)
    assert without_costs(one) != without_costs(made_result("k", log_digest="another"))
