import importlib.util
import json
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from research.train import train_log
from research.train.train_log import TrainLog, draw_history

LINES = [
    {"step": 20, "seconds": 1.0, "loss_total": 2.0, "loss_semantic": 1.5, "rate": 1e-3, "rooms": 4, "waited_s": 0.1},
    {"step": 40, "seconds": 2.0, "loss_total": 1.0, "loss_semantic": 0.7, "rate": 5e-4, "rooms": 6, "waited_s": 0.1},
    {"step": 40, "seconds": 2.5, "miou": 0.2, "accuracy": 0.5, "blind_miou": 0.1, "blind_accuracy": 0.4},
]


def test_the_history_grows_line_by_line_and_starts_again_from_what_the_state_knows(tmp_path: Path):
    def written() -> list[dict]:
        return [json.loads(line) for line in (tmp_path / "history.jsonl").read_text().splitlines()]

    history: list[dict] = []
    with TrainLog(tmp_path, history) as log:
        for line in LINES:
            log.add(line)
        assert written() == LINES == history
    with TrainLog(tmp_path, LINES[:1]):
        assert written() == LINES[:1]
    assert (tmp_path / "curves.png").is_file()


def test_without_a_folder_the_history_stays_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    history: list[dict] = []
    with TrainLog(None, history) as log:
        log.add(LINES[0])
        log.draw()
    assert history == LINES[:1] and list(tmp_path.iterdir()) == []


@pytest.mark.skipif(importlib.util.find_spec("tensorboard") is not None, reason="tensorboard is installed")
def test_without_tensorboard_one_line_of_the_log_says_so(tmp_path: Path):
    with capture_logs() as logs, TrainLog(tmp_path, []) as log:
        log.add(LINES[0])
    assert [line["event"] for line in logs] == ["no_tensorboard_files"]
    assert not (tmp_path / "tensorboard").exists()


@pytest.mark.skipif(importlib.util.find_spec("tensorboard") is None, reason="tensorboard is not installed")
def test_with_tensorboard_its_event_files_hold_the_figures(tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with TrainLog(tmp_path, []) as log:
        for line in LINES:
            log.add(line)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(e.step, round(e.value, 6)) for e in events.Scalars("loss/total")] == [(20, 2.0), (40, 1.0)]
    assert [round(e.value, 6) for e in events.Scalars("validation/mIoU without depth")] == [0.1]


def test_a_picture_can_be_drawn_before_there_is_anything_to_draw():
    for history in ([], LINES[:1], LINES):
        picture = draw_history(history)
        assert picture.shape[1] > 1000 and picture.std() > 1


def test_without_matplotlib_one_line_of_the_log_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(train_log, "cannot_draw", lambda: "Matplotlib is not installed")
    with capture_logs() as logs, TrainLog(tmp_path, []) as log:
        log.add(LINES[0])
        log.draw()
    said = [line["event"] for line in logs if line["event"] != "no_tensorboard_files"]
    assert said == ["no_curves_picture"] and not (tmp_path / "curves.png").exists()
