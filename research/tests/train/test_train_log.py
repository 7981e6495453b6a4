import json
from pathlib import Path

import pytest

from research.train.train_log import TrainLog

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
