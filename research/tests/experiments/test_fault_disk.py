"""The disk of the fault table: what is recorded, lost and deleted adds up."""

from __future__ import annotations

from pathlib import Path

import pytest

from research.experiments import fault_disk


def test_where_there_is_room_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fault_disk, "FRAMES", 60)
    found = fault_disk.fill(tmp_path, "delete-oldest", 0)
    assert (found["lost"], found["deleted"], found["unaccounted"]) == (0, 0, 0)


def test_a_frame_that_is_missing_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fault_disk, "FRAMES", 120)
    read = fault_disk.parts_on_disk
    monkeypatch.setattr(fault_disk, "parts_on_disk", lambda path: {0: read(path)[0]})
    assert fault_disk.fill(tmp_path, "stop", 0)["unaccounted"] > 0
