"""Runs of a fleet: what a worker makes of one log, and the driver on a real Ray cluster in this machine."""

import hashlib
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from msgspec import to_builtins

from semantic_mapper.errors import ConfigError, FleetError, LogError, StoreError
from semantic_mapper.nodes.fleet import run
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.fleet.run import RunReport, Task, run_fleet, run_task
from semantic_mapper.nodes.fleet.store import LogInput, Store, TaskResult
from semantic_mapper.replay.summary import read_summary
from tests.contract.golden import form, undocumented
from tests.nodes.fleet.tasks import do_as_named


def task_of(operation: str, out: Path, weights: Path, config: Path | None = None, *sets: str) -> Task:
    return run.make_task(operation, str(out), str(weights), sets, config)


def done(task: Task, log: Path) -> TaskResult:
    """The result of a task that is done in this process, with all of its files."""
    assert run_task(task, LogInput(str(log)))
    store = Store(task.store)
    (found,) = (result for result in store.results() if result.operation == task.operation)
    assert found.findings.metrics
    for name, digest in found.files.items():
        assert hashlib.sha256(store.find(f"{found.folder}/{name}") or b"").hexdigest() == digest
    return found


def test_a_replay_of_the_fleet_is_that_of_the_verb(
    tmp_path: Path, log: Path, weights: Path, config: Path, replayed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of("map", tmp_path / "store", weights, config)
    found = done(task, log)
    assert set(found.files) >= {"map.npz", "summary.json", "report.html", "overview.png"}
    assert found.files["map.npz"] == run.file_digest(replayed / "map.npz")
    summary = read_summary(replayed)
    assert found.findings.metrics["miou"] == summary["metrics"]["miou"]
    assert found.findings.metrics["frames_fused"] == summary["frames"]["fused"] == 6
    (scores,) = found.findings.scores
    assert scores.iou == summary["metrics"]["per_class"]

    monkeypatch.setattr(run, "_upload", lambda *args: pytest.fail("done again"))
    copied = shutil.copy(log, tmp_path / "other-name.mcap")  # the content counts, not the name
    assert not run_task(task, LogInput(str(copied)))
    monkeypatch.setattr(run, "file_digest", lambda path: pytest.fail("read again"))
    assert not run_task(task, LogInput(str(log)))


def test_other_settings_weights_content_or_code_are_another_result(tmp_path: Path, weights: Path) -> None:
    task = task_of("map", tmp_path, weights)
    others = [replace(task, weights_data=b"other"), replace(task, code="other"), replace(task, operation="eval")]
    others.append(task_of("map", tmp_path, weights, None, "max_frames=2"))
    keys = {task.key("digest"), task.key("other"), *(other.key("digest") for other in others)}
    assert len(keys) == 6
    assert task_of("map", tmp_path, weights, None, "max_frames=0").key("digest") in keys


@pytest.mark.parametrize(
    ("operation", "sets", "file", "metric"),
    [
        ("eval", "max_frames=2", "eval.html", ("frames_scored", 2)),
        ("autolabel", "max_frames=2", "labelled.mcap", ("frames", 2)),
        ("finetune", "keyframes=2 steps=1 seconds=0 width=96", "weights.safetensors", ("steps", 1)),
    ],
)
def test_operations_leave_their_files_and_figures(
    tmp_path: Path, log: Path, weights: Path, config: Path, operation: str, sets: str, file: str, metric: Any
) -> None:
    settings = None if operation == "finetune" else config
    found = done(task_of(operation, tmp_path, weights, settings, *sets.split()), log)
    assert file in found.files and found.findings.metrics[metric[0]] == metric[1]
    if operation == "eval":
        assert found.findings.scores[0].method == "sray"
        assert found.findings.metrics["miou"] == found.findings.metrics["miou sray"]


def test_what_a_worker_cannot_do_says_why(tmp_path: Path, log: Path, weights: Path) -> None:
    task = task_of("map", tmp_path / "store", weights)
    for changes, url, error, why in (
        ({"code": "other"}, log, FleetError, "install the same everywhere"),
        ({}, tmp_path / "none.mcap", LogError, "no such log"),
        ({}, tmp_path, LogError, "a folder without logs"),
        ({"store": str(tmp_path / "none")}, log, StoreError, "--out must be a bucket"),
    ):
        with pytest.raises(error, match=why):
            run_task(replace(task, **changes), LogInput(str(url)))
    assert not list(Store(task.store).results())


def test_no_store_is_made_for_what_cannot_be_run(tmp_path: Path) -> None:
    for operation, weights, sets, why in (
        ("map", None, "max_frame=3", "did you mean `max_frames`"),
        ("finetune", None, "second=3", "did you mean `seconds`"),
        ("map", None, "voxel_map.voxel_size=3", "voxel_size_m"),
        ("map", "none.safetensors", "max_frames=3", r"none\.safetensors: is missing"),
    ):
        with pytest.raises((ConfigError, StoreError), match=why):
            run.make_task(operation, str(tmp_path / "store"), weights, [sets])
    assert not (tmp_path / "store").exists()


# The driver


@pytest.fixture(scope="module")
def _cluster() -> Iterator[None]:
    with connected(None, cpus=2):
        yield


def run_logs(folder: Path, *logs: str, **options: Any) -> RunReport:
    (folder / "traces").mkdir(exist_ok=True)
    task = Task("map", Store(str(folder / "store"), create=True).url, {}, {}, "", b"", "")
    inputs = [LogInput(log, {"traces": str(folder / "traces")}) for log in logs]
    return run_fleet(task, inputs, memory_gb=0.001, function=do_as_named, **options)


def traces(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "traces").iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("_cluster")
def test_every_log_is_done_once_and_the_rest_goes_on_without_those_that_fail(tmp_path: Path) -> None:
    names = [f"log{n:02}" for n in range(20)]
    report = run_logs(tmp_path, *names, "exists", "bad", "away-once", "dies-once", "dies")
    assert (report.total, report.done, report.existing, len(report.failures)) == (25, 22, 1, 2)
    assert undocumented("fleet run", form(to_builtins(report))) == []
    expected = [*(f"{name}.0" for name in names), "exists.0", "bad.0"]
    expected += ["away-once.0", "away-once.1", "dies-once.0", "dies-once.1", *(f"dies.{n}" for n in range(4))]
    assert traces(tmp_path) == sorted(expected)
    failures = {failure.log: failure.error for failure in Store(str(tmp_path / "store")).failures()}
    assert failures["bad"] == "LogError: bad: cannot be read"
    assert "the process of the task died 4 times" in failures["dies"]


@pytest.mark.slow
@pytest.mark.usefixtures("_cluster")
def test_a_stop_ends_tasks_at_once_and_the_same_command_tries_failed_logs_again(tmp_path: Path) -> None:
    report = run_logs(tmp_path, "sleeps1", "sleeps2", "sleeps3", stopped=lambda: len(traces(tmp_path)) == 2)
    assert report.over == 0
    assert len(run_logs(tmp_path, "bad-once").failures) == 1, "the processors are free again"
    assert run_logs(tmp_path, "bad-once").done == 1
    assert not list(Store(str(tmp_path / "store")).failures())


@pytest.mark.slow
@pytest.mark.usefixtures("_cluster")
def test_what_no_node_has_is_refused_at_once(tmp_path: Path) -> None:
    task = Task("map", Store(str(tmp_path), create=True).url, {}, {}, "", b"", "")
    for needs, what in (({"cpus": 64}, "64 CPUs"), ({"gpus": 1}, "1 GPUs"), ({"memory_gb": 1e6}, "1e.06 GB")):
        with pytest.raises(FleetError, match=what):
            run_fleet(task, [LogInput("a")], function=do_as_named, **needs)
