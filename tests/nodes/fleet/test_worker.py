from __future__ import annotations

import errno
import shutil
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import msgspec
import pytest

from semantic_mapper.errors import ConfigError, LogError, StoreError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.fleet import operations, scratch, urls, worker
from semantic_mapper.nodes.fleet.metrics import direction_of
from semantic_mapper.nodes.fleet.operations import changed_settings, read_settings
from semantic_mapper.nodes.fleet.results import Findings, TaskResult, without_costs
from semantic_mapper.nodes.fleet.scratch import DiskError
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


def expect_directions(found: TaskResult) -> None:
    """A gate can judge each metric, or says why not."""
    assert found.findings.metrics
    for metric in found.findings.metrics:
        direction_of(metric)


def test_a_replay_of_the_fleet_is_that_of_the_verb(
    store: Store, log: Path, weights: Path, config: Path, replayed: Path
) -> None:
    outcome = run_task(task_of("replay", store, log, weights, config))
    found = store.result(outcome.key)
    assert outcome.status == "done" and found is not None
    assert set(found.files) >= {"map.npz", "summary.json", "report.html", "overview.png", "thumbnail.jpg"}
    assert store.read(f"{found.folder}/map.npz") == (replayed / "map.npz").read_bytes()
    summary = msgspec.json.decode((replayed / "summary.json").read_bytes())
    expect_directions(found)
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
    expect_directions(found)
    assert found.findings.metrics["miou"] == found.findings.metrics["miou sray"]
    assert {row.method for row in found.findings.segments} == {"sray", "sray, novel view", "own image alone"}


def test_autolabel_and_finetune_leave_their_files(store: Store, log: Path, weights: Path, config: Path) -> None:
    labelled = store.result(run_task(task_of("autolabel", store, log, weights, config, "max_frames=2")).key)
    assert labelled is not None and labelled.findings.metrics["frames"] == 2 and "labelled.mcap" in labelled.files
    expect_directions(labelled)
    sets = ("keyframes=2", "steps=1", "seconds=0", "width=96")
    learned = store.result(run_task(task_of("finetune", store, log, weights, None, *sets)).key)
    assert learned is not None and "weights.safetensors" in learned.files and learned.findings.metrics["steps"] == 1
    expect_directions(learned)


def test_refine_takes_maps(store: Store, replayed: Path) -> None:
    template = make_template("refine", store, "smoothed", ["up=z"])
    found = store.result(run_task(replace(template, url=str(replayed / "map.npz"))).key)
    assert found is not None and store.local is not None
    expect_directions(found)
    refined = VoxelMap.load(store.local / found.folder / "map.npz")
    assert len(refined.points().xyz) >= found.findings.metrics["surface"] > 0
    assert refined.block_count == VoxelMap.load(replayed / "map.npz").block_count


def test_settings_are_shown_by_the_names_that_set_them() -> None:
    settings = read_settings("replay", ["voxel_map.voxel_size_m=0.05", "max_frames=3"])
    assert changed_settings(settings) == {"voxel_map.voxel_size_m": 0.05, "max_frames": 3}
    assert changed_settings(read_settings("finetune", ["steps=5"])) == {"steps": 5}


@pytest.mark.parametrize(
    ("operation", "text", "why"),
    [
        ("replay", "max_frame=3", r"--set max_frame: `replay` has no such setting; did you mean `max_frames`"),
        ("finetune", "second=3", "did you mean `seconds`"),
        ("refine", "seconds=3", "there is fill, up, by_name"),
        ("finetune", "kind=panoptic", "kind"),
        ("replay", "voxel_map.size=3", "unknown key `size`"),
        ("replay", "quality", "NAME=VALUE"),
        ("replay", "max_frames=many", "max_frames"),
    ],
)
def test_a_wrong_setting_says_what_there_is(operation: str, text: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        read_settings(operation, [text])


def test_a_log_that_changes_while_it_is_read_fails(
    store: Store, log: Path, weights: Path, config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growing = Path(shutil.copy(log, tmp_path / "growing.mcap"))
    operate = worker._operate

    def grow(*arguments: Any) -> Findings:
        found = operate(*arguments)
        growing.touch()
        return found

    monkeypatch.setattr(worker, "_operate", grow)
    with pytest.raises(LogError, match="changed while it was read"):
        run_task(task_of("replay", store, growing, weights, config))
    assert list(store.results()) == []


def test_a_full_disk_is_told_apart_from_a_bad_log(
    store: Store, log: Path, weights: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(operation: str, job: operations.Job) -> Findings:
        raise ConfigError("map.npz: cannot be written") from OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(operations, "run_operation", fill)
    with pytest.raises(DiskError, match="is full"):
        run_task(task_of("replay", store, log, weights, config))


class _Answer(BaseHTTPRequestHandler):
    """``/404/...`` answers with 404, and so on."""

    def do_GET(self) -> None:
        self.send_error(int(self.path.split("/")[1]))

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *arguments: Any) -> None:
        """Nothing."""


@pytest.mark.parametrize(("status", "error"), [(404, LogError), (403, StoreError), (500, StoreError)])
def test_only_what_a_server_does_not_have_is_missing(
    store: Store, weights: Path, monkeypatch: pytest.MonkeyPatch, status: int, error: type[Exception]
) -> None:
    monkeypatch.setattr(urls.time, "sleep", lambda seconds: None)
    with ThreadingHTTPServer(("127.0.0.1", 0), _Answer) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/{status}/a.mcap?X-Amz-Signature=SECRET"
        with pytest.raises(error) as caught:
            run_task(replace(task_of("replay", store, Path("a"), weights), url=url))
        server.shutdown()
    assert "SECRET" not in str(caught.value) and f"/{status}/a.mcap" in str(caught.value)


def test_a_log_that_is_no_log_fails_with_its_name(store: Store, weights: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"nothing\.mcap: no such log"):
        run_task(task_of("replay", store, tmp_path / "nothing.mcap", weights))
    with pytest.raises(LogError, match=r"replay\.toml"):
        run_task(task_of("replay", store, REPLAY_LAUNCH, weights))
