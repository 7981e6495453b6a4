"""A fleet whose logs and store are on an S3 server that fails now and then."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import fsspec
import pytest

from semantic_mapper.errors import StoreError
from semantic_mapper.nodes.fleet import urls
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.fleet.inputs import find_inputs
from semantic_mapper.nodes.fleet.results import without_costs
from semantic_mapper.nodes.fleet.runner import FleetRun, Resources
from semantic_mapper.nodes.fleet.start import make_template
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.tables import query
from semantic_mapper.nodes.fleet.urls import persistently
from semantic_mapper.nodes.fleet.worker import run_task
from tests.nodes.fleet.documents import made_result
from tests.nodes.fleet.s3_server import ACCESS_KEY, SECRET_KEY, FaultPlan, S3Server, failing_s3_server, s3_server
from tests.nodes.support import write_log
from tests.small import tiny_frames

FAULTS = FaultPlan(seed=5, error=0.08, slow=0.08, cut=0.05, lost=0.05)
SMALL = Resources(cpus=1.0, memory_bytes=1 << 20)
LOGS = 3


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """Two buckets; nothing fails."""
    for bucket in ("logs", "results"):
        (tmp_path / "served" / bucket).mkdir(parents=True)
    with s3_server(tmp_path / "served") as server:
        server.use(monkeypatch)
        yield server


def test_of_two_writers_to_a_bucket_one_commits(served: S3Server) -> None:
    stores = [Store("s3://results/one", create=True) for _ in range(2)]
    for store, attempt in zip(stores, ("one", "two"), strict=True):
        store.write(f"results/k/{attempt}/map.npz", attempt.encode())
    made = [store.commit(made_result("k", attempt)) for store, attempt in zip(stores, ("one", "two"), strict=True)]
    assert made == [True, False]
    assert stores[1].result("k") == made_result("k", "one")
    assert not stores[0].exists("results/k/two/map.npz") and stores[0].exists("results/k/one/map.npz")


def test_many_writers_at_once_commit_one_result(served: S3Server) -> None:
    store = Store("s3://results/many", create=True)
    made: list[bool] = []
    threads = [
        threading.Thread(target=lambda n=n: made.append(store.commit(made_result("k", f"attempt{n}"))))
        for n in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(made) == 1


def test_a_manifest_and_globs_are_read_from_a_bucket(served: S3Server) -> None:
    files = fsspec.filesystem("s3")
    files.pipe_file("logs/fleet.csv", b"log,robot\nsite/a.mcap,r1\n")
    files.pipe_file("logs/site/a.mcap", b"a")
    files.pipe_file("logs/site/b.mcap", b"b")
    (tagged,) = find_inputs(["s3://logs/fleet.csv"], ".mcap")
    assert (tagged.url, tagged.tags) == ("s3://logs/site/a.mcap", {"robot": "r1"})
    found = find_inputs(["s3://logs/site/*.mcap"], ".mcap")
    assert [item.url for item in found] == ["s3://logs/site/a.mcap", "s3://logs/site/b.mcap"]


def test_wrong_keys_are_one_clear_error(served: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    with pytest.raises(StoreError, match="s3://results/one") as caught:
        Store("s3://results/one", create=True)
    assert "wrong" not in str(caught.value) and SECRET_KEY not in str(caught.value)


@pytest.mark.slow
def test_a_fleet_gets_over_errors_slow_reads_and_cut_connections(
    tmp_path: Path, weights: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = [write_log(tmp_path / f"room{n}.mcap", tiny_frames(6, seed=n)) for n in range(LOGS)]
    serial = Store(str(tmp_path / "serial"), create=True)
    template = make_template("replay", serial, str(weights), (), config)
    for log in logs:
        run_task(replace(template, url=str(log)))
    wanted = {result.key: without_costs(result) for result in serial.results()}

    monkeypatch.setattr(urls, "FIRST_PAUSE_S", 0.05)
    with failing_s3_server(FAULTS, "logs", "results") as server:
        server.use(monkeypatch)
        files = fsspec.filesystem("s3", use_listings_cache=False)
        for log in logs:
            persistently(lambda: files.pipe_file(f"logs/{log.name}", log.read_bytes()), log.name)  # noqa: B023
        store = Store("s3://results/fleet", create=True)
        template = make_template("replay", store, str(weights), (), config)
        inputs = find_inputs(["s3://logs/*.mcap"], ".mcap")
        with connected(None, cpus=2) as cluster:
            status = FleetRun(store, template, inputs, SMALL, cluster).run(lambda: False, lambda now: None)
            assert (status.done, status.failed, status.total) == (LOGS, 0, LOGS)
            again = FleetRun(store, template, inputs, SMALL, cluster).run(lambda: False, lambda now: None)
            assert (again.done, again.existing) == (0, LOGS)
        assert {result.key: without_costs(result) for result in store.results()} == wanted
        for result in store.results():
            (one,) = (r for r in serial.results() if r.key == result.key)
            assert store.read(f"{result.folder}/map.npz") == serial.read(f"{one.folder}/map.npz")
        (rows,) = query(store, "SELECT count(*) AS n FROM logs").to_pylist()
        assert rows["n"] == LOGS
        assert all(server.counts[kind] for kind in ("error", "slow", "cut", "lost"))
        kept = [files.cat_file(path) for path in files.find("results")]
    assert kept
    assert not any(key.encode() in data for data in kept for key in (ACCESS_KEY, SECRET_KEY))
