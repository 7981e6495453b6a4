"""The scheduler on a real Ray cluster in this machine, with tasks that fail, die and hang."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from semantic_mapper.errors import FleetError, StoreError
from semantic_mapper.nodes.fleet import runner
from semantic_mapper.nodes.fleet.cluster import Cluster, connected
from semantic_mapper.nodes.fleet.inputs import LogInput
from semantic_mapper.nodes.fleet.runner import DriverStatus, FleetRun, Resources
from semantic_mapper.nodes.fleet.scratch import DiskError
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.worker import Outcome, Task
from tests.nodes.fleet import tasks

pytestmark = pytest.mark.slow

SMALL = Resources(cpus=1.0, memory_bytes=1 << 20)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with connected(None, cpus=2) as found:
        yield found


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(str(tmp_path / "store"), create=True)


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "FIRST_PAUSE_S", 0.05)


def run_fleet(
    store: Store,
    cluster: Cluster,
    function: Callable[[Task], Outcome],
    logs: list[str],
    traces: Path,
    *,
    resources: Resources = SMALL,
    stopped: Callable[[], bool] = lambda: False,
    retry: bool = False,
    code: str = "",
) -> DriverStatus:
    traces.mkdir(exist_ok=True)
    template = Task("replay", "", {}, store.url, {}, {}, "", "", weights_stored=False, code=code)
    inputs = [LogInput(log, {"traces": str(traces)}) for log in logs]
    fleet = FleetRun(store, template, inputs, resources, cluster, retry_quarantined=retry, function=function)
    return fleet.run(stopped, lambda status: None)


def names(traces: Path) -> list[str]:
    return sorted(path.name for path in traces.iterdir())


def test_every_log_is_done_once(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    status = run_fleet(store, cluster, tasks.note, [f"log{n:03}" for n in range(100)], tmp_path / "traces")
    assert (status.done, status.failed, status.retries, status.ended) == (100, 0, 0, "done")
    assert names(tmp_path / "traces") == [f"log{n:03}.1" for n in range(100)]


def test_a_log_that_fails_twice_is_quarantined_and_the_rest_is_done(
    store: Store, cluster: Cluster, tmp_path: Path
) -> None:
    traces = tmp_path / "traces"
    status = run_fleet(store, cluster, tasks.fail_for_bad, ["good", "once", "bad"], traces)
    assert (status.done, status.failed, status.retries) == (2, 1, 2)
    assert names(traces) == ["bad.1", "bad.2", "good.1", "once.1", "once.2"]
    (failure,) = store.failures()
    assert failure.log == "bad" and len(failure.errors) == 2 and "bad: cannot be read" in failure.errors[0]


def test_a_quarantined_log_waits_until_it_is_asked_for(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    run_fleet(store, cluster, tasks.fail_for_bad, ["bad"], tmp_path / "one")
    status = run_fleet(store, cluster, tasks.note, ["bad"], tmp_path / "two")
    assert (status.done, status.failed) == (0, 1) and names(tmp_path / "two") == []
    status = run_fleet(store, cluster, tasks.note, ["bad"], tmp_path / "three", retry=True)
    assert (status.done, status.failed) == (1, 0) and not list(store.failures())


def test_a_log_that_kills_its_process_is_quarantined(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    traces = tmp_path / "traces"
    status = run_fleet(store, cluster, tasks.die_for_bad, ["good", "once", "bad"], traces)
    assert (status.done, status.failed) == (2, 1)
    assert names(traces) == ["bad.1", "bad.2", "bad.3", "good.1", "once.1", "once.2"]
    (failure,) = store.failures()
    assert "the process died" in failure.errors[-1]


def test_a_store_that_was_away_is_no_fault_of_the_log(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    status = run_fleet(store, cluster, tasks.miss_store_once, ["first", "second"], tmp_path / "traces")
    assert (status.done, status.failed, status.retries) == (2, 0, 1)


def test_a_store_that_stays_away_ends_the_run(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="in a row"):
        run_fleet(store, cluster, tasks.miss_store, [f"log{n}" for n in range(20)], tmp_path / "traces")
    assert not list(store.failures())


def test_a_stop_ends_tasks_at_once_and_says_so(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    traces = tmp_path / "traces"
    traces.mkdir()
    status = run_fleet(
        store, cluster, tasks.sleep_long, ["a", "b", "c"], traces, stopped=lambda: len(names(traces)) == 2
    )
    assert (status.done, status.ended) == (0, "stopped")
    (name,) = store.names("drivers")
    written = msgspec.json.decode(store.read(f"drivers/{name}"), type=DriverStatus)
    assert written.ended == "stopped" and written.total == 3
    began = time.monotonic()
    again = run_fleet(store, cluster, tasks.note, ["d"], tmp_path / "more")  # the processors are free again
    assert again.done == 1 and time.monotonic() - began < 250  # far less than a task that still slept


def test_a_log_that_takes_too_long_is_quarantined_and_those_behind_it_are_done(
    store: Store, cluster: Cluster, tmp_path: Path
) -> None:
    resources = Resources(cpus=1.0, memory_bytes=1 << 20, timeout_s=4.0)
    logs = ["slow", *(f"log{n}" for n in range(12))]  # more than a time limit holds, one after the other
    status = run_fleet(store, cluster, tasks.sleep_for_slow, logs, tmp_path / "traces", resources=resources)
    assert (status.done, status.failed) == (12, 1)
    (failure,) = store.failures()
    assert failure.log == "slow" and failure.errors == ("took longer than 4 s, and was ended",) * 2


def test_a_full_disk_is_no_fault_of_the_logs(store: Store, cluster: Cluster, tmp_path: Path) -> None:
    with pytest.raises(DiskError, match="5 logs in a row"):
        run_fleet(store, cluster, tasks.fill_disk, [f"log{n}" for n in range(20)], tmp_path / "traces")
    assert not list(store.failures())


def test_a_log_that_cannot_be_reached_is_quarantined_and_the_rest_is_done(
    store: Store, cluster: Cluster, tmp_path: Path
) -> None:
    status = run_fleet(store, cluster, tasks.miss_one_log, ["far", "a", "b"], tmp_path / "traces")
    assert (status.done, status.failed) == (2, 1)
    assert [failure.log for failure in store.failures()] == ["far"]


def test_a_run_goes_on_where_its_progress_cannot_be_written(
    store: Store, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Store.write

    def refuse(self: Store, name: str, data: bytes, **options: int) -> None:
        if name.startswith("drivers/"):
            raise StoreError("full")
        write(self, name, data, **options)

    monkeypatch.setattr(Store, "write", refuse)
    assert run_fleet(store, cluster, tasks.note, ["a", "b"], tmp_path / "traces").done == 2


def test_other_code_tries_a_quarantined_log_again_and_forgets_the_failure(
    store: Store, cluster: Cluster, tmp_path: Path
) -> None:
    run_fleet(store, cluster, tasks.fail_for_bad, ["bad"], tmp_path / "one")
    status = run_fleet(store, cluster, tasks.note, ["bad"], tmp_path / "two", code="newer")
    assert (status.done, status.failed) == (1, 0) and not list(store.failures())


@pytest.mark.parametrize(("max_parallel", "task"), [(0, tasks.need_company), (1, tasks.refuse_company)])
def test_no_more_run_at_a_time_than_allowed(
    store: Store, cluster: Cluster, tmp_path: Path, max_parallel: int, task: Callable[[Task], Outcome]
) -> None:
    resources = Resources(cpus=0.25, memory_bytes=1 << 20, max_parallel=max_parallel)
    logs = [f"log{n}" for n in range(16)]
    status = run_fleet(store, cluster, task, logs, tmp_path / "traces", resources=resources)
    assert (status.done, status.failed) == (16, 0)


@pytest.mark.parametrize(
    ("resources", "what"),
    [(Resources(cpus=64), "64 CPUs"), (Resources(gpus=1), "1 GPUs"), (Resources(memory_bytes=1 << 50), "GB of memory")],
)
def test_what_no_node_has_is_refused_at_once(
    store: Store, cluster: Cluster, tmp_path: Path, resources: Resources, what: str
) -> None:
    with pytest.raises(FleetError, match=what):
        run_fleet(store, cluster, tasks.note, ["a"], tmp_path / "traces", resources=resources)
