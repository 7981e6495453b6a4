from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from semantic_mapper.errors import LogError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.fleet import scratch, worker
from semantic_mapper.nodes.fleet.results import without_costs
from semantic_mapper.nodes.fleet.start import make_template
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.worker import OtherCodeError, Task, run_task
from tests.nodes.support import REPLAY_LAUNCH


@pytest.fixture(autouse=True)
def _own_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch.tempfile, "gettempdir", lambda: str(tmp_path))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(str(tmp_path / "store"), create=True)


def task_of(operation: str, store: Store, log: Path, weights: Path, config: Path | None = None, *sets: str) -> Task:
    return replace(make_template(operation, store, str(weights), sets, config), url=str(log))


def test_a_replay_of_the_fleet_is_that_of_the_verb(
    store: Store, log: Path, weights: Path, config: Path, replayed: Path
) -> None:
    outcome = run_task(task_of("replay", store, log, weights, config))
    found = store.result(outcome.key)
    assert outcome.status == "done" and found is not None
    assert set(found.files) >= {"map.npz", "summary.json", "report.html", "overview.png", "thumbnail.jpg"}
    assert store.read(f"{found.folder}/map.npz") == (replayed / "map.npz").read_bytes()
    summary = msgspec.json.decode((replayed / "summary.json").read_bytes())
    assert found.findings.metrics["miou"] == summary["metrics"]["miou"]
    assert found.findings.metrics["frames_fused"] == summary["frames"]["fused"] == 6
    assert {row.name: row.iou for row in found.findings.classes} == summary["metrics"]["per_class"]
    assert sum(row.frames for row in found.findings.segments) == summary["frames"]["scored"]
    assert sum(sum(row.counts) for row in found.findings.segments) == summary["metrics"]["pixels"]


def test_what_is_done_is_not_done_again(
    store: Store, log: Path, weights: Path, config: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    task = task_of("replay", store, log, weights, config)
    first = run_task(task)
    monkeypatch.setattr(worker, "_make_result", lambda *args: pytest.fail("done again"))
    assert run_task(task).status == "exists"
    copied = Path(shutil.copy(log, tmp_path / "other-name.mcap"))  # the content counts, not the name
    again = run_task(replace(task, url=str(copied)))
    assert (again.status, again.key) == ("exists", first.key)


def test_a_log_that_was_read_before_is_not_read_again(
    store: Store, log: Path, weights: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of("replay", store, log, weights, config)
    run_task(task)
    monkeypatch.setattr(worker, "file_digest", lambda path: pytest.fail("read again"))
    assert run_task(task).status == "exists"


def test_other_settings_weights_or_content_are_another_result(
    store: Store, log: Path, weights: Path, config: Path
) -> None:
    task = task_of("replay", store, log, weights, config)
    keys = {
        worker.task_key(task, "digest"),
        worker.task_key(task, "other digest"),
        worker.task_key(replace(task, weights_digest="other"), "digest"),
        worker.task_key(replace(task, code="other"), "digest"),
        worker.task_key(replace(task, operation="eval"), "digest"),
        worker.task_key(task_of("replay", store, log, weights, config, "max_frames=2"), "digest"),
    }
    assert len(keys) == 6
    same = task_of("replay", store, log, weights, config, "max_frames=0")  # the default, said aloud
    assert worker.task_key(same, "digest") == worker.task_key(task, "digest")


def test_two_attempts_make_the_same_result(
    store: Store, log: Path, weights: Path, config: Path, tmp_path: Path
) -> None:
    other = Store(str(tmp_path / "other"), create=True)
    one, two = (run_task(task_of("replay", s, log, weights, config)) for s in (store, other))
    first, second = store.result(one.key), other.result(two.key)
    assert first is not None and second is not None
    assert without_costs(first) == without_costs(second)


def test_other_code_is_refused(store: Store, log: Path, weights: Path) -> None:
    task = replace(task_of("replay", store, log, weights), code="other")
    with pytest.raises(OtherCodeError, match="install the same everywhere"):
        run_task(task)


def test_eval_scores_every_method(store: Store, log: Path, weights: Path, config: Path) -> None:
    outcome = run_task(task_of("eval", store, log, weights, config, "max_frames=3"))
    found = store.result(outcome.key)
    assert found is not None and found.settings["max_frames"] == 3
    assert {"eval.json", "eval.html"} <= set(found.files)
    assert found.findings.metrics["miou"] == found.findings.metrics["miou sray"]
    assert {row.method for row in found.findings.segments} == {"sray", "sray, novel view", "own image alone"}


def test_autolabel_and_finetune_leave_their_files(store: Store, log: Path, weights: Path, config: Path) -> None:
    labelled = store.result(run_task(task_of("autolabel", store, log, weights, config, "max_frames=2")).key)
    assert labelled is not None and labelled.findings.metrics["frames"] == 2 and "labelled.mcap" in labelled.files
    sets = ("keyframes=2", "steps=1", "seconds=0", "width=96")
    learned = store.result(run_task(task_of("finetune", store, log, weights, None, *sets)).key)
    assert learned is not None and "weights.safetensors" in learned.files and learned.findings.metrics["steps"] == 1


def test_refine_takes_maps(store: Store, replayed: Path) -> None:
    template = make_template("refine", store, "smoothed", ["up=z"])
    found = store.result(run_task(replace(template, url=str(replayed / "map.npz"))).key)
    assert found is not None and store.local is not None
    refined = VoxelMap.load(store.local / found.folder / "map.npz")
    assert len(refined.points().xyz) >= found.findings.metrics["surface"] > 0
    assert refined.block_count == VoxelMap.load(replayed / "map.npz").block_count


def test_a_log_that_is_no_log_fails_with_its_name(store: Store, weights: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"nothing\.mcap: no such log"):
        run_task(task_of("replay", store, tmp_path / "nothing.mcap", weights))
    with pytest.raises(LogError, match=r"replay\.toml"):
        run_task(task_of("replay", store, REPLAY_LAUNCH, weights))
