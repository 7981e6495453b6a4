"""``boxes``."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.labels import ROOMS
from tests.nodes.support import refused, run
from tests.small import tiny_frames


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A chair a metre in front of the first frame of the log, and a wall behind it."""
    T = tiny_frames(6)[0].T_world_camera
    chair, wall = np.eye(4), np.eye(4)
    chair[:3, 3], wall[:3, 3] = (T @ (0, 0, 1.0, 1))[:3], (T @ (0, 0, -3.0, 1))[:3]
    boxes = [
        {"id": 2, "class": "chair", "T_world_box": chair.tolist(), "size": [0.3, 0.3, 0.4]},
        {"id": 5, "class": "wall", "T_world_box": wall.tolist(), "size": [1, 1, 2]},
    ]
    (path := tmp_path / "boxes.json").write_text(json.dumps({"boxes": boxes}))
    return path


def test_boxes_are_listed_for_people_and_programs(file: Path) -> None:
    text = file.read_bytes()
    listed = json.loads(run("info", file, "--json").stdout)
    assert [(b["id"], b["class"], b["thing"]) for b in listed["boxes"]] == [(2, "chair", True), (5, "wall", False)]
    assert "chair" in run("info", file).stdout and file.read_bytes() == text


def test_boxes_are_drawn_where_the_frames_show_them(file: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "boxes.jpg"
    done = run("info", file, "--picture", log, "--out", out)
    assert out.read_bytes().startswith(b"\xff\xd8") and "1 of 2 boxes in view of its frames; written" in done.stdout
    color = np.array(ROOMS.colors[ROOMS.names.index("chair")])[::-1]
    tiles = np.asarray(cv2.imread(str(out)))[110 : 110 + 300, 24 : 24 + 3 * 512].astype(int)
    assert (np.abs(tiles - color).max(-1) < 30).sum() > 300


def test_wrong_use_changes_nothing(file: Path, log: Path, tmp_path: Path) -> None:
    text = file.read_bytes()
    for words in (("--picture", log), ("--out", tmp_path / "b.png")):
        assert run("info", file, *words).returncode == 2, words
    (tmp_path / "boxes.png").symlink_to(file)
    assert "the result is made from it" in refused("info", file, "--picture", log, "--out", tmp_path / "boxes.png")
    assert file.read_bytes() == text
