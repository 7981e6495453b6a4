"""``info`` of maps and boxes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.labels import ROOMS
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import refused, run_ok
from tests.small import tiny_frames


def test_info_of_a_map_says_what_it_is(tmp_path: Path) -> None:
    voxel_map, path = small_map(voxel_size_m=0.03), tmp_path / "map.npz"
    fuse_sphere(voxel_map, 3)
    voxel_map.save(path)
    said = run_ok("info", path).stdout
    assert all(text in said for text in ("version 3", "3, the last one at", "3 cm", "72", "three: table, cup, wall"))
    found = json.loads(run_ok("info", path, "--json").stdout)
    assert (found["frames"], found["last_stamp_ns"], found["blocks"]) == (3, 1002, voxel_map.block_count)
    keys = voxel_map.block_state()["keys"]
    np.testing.assert_allclose(found["bounds_m"], [keys.min(axis=0) * 0.24, (keys.max(axis=0) + 1) * 0.24])
    assert found["label_set"] == {"name": "three", "ids": [5, 9, 2], "classes": ["table", "cup", "wall"]}
    assert found["config"]["voxel_size_m"] == 0.03 and found["size_bytes"] == path.stat().st_size


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


def test_boxes_are_listed_and_drawn_where_the_frames_show_them(file: Path, log: Path, tmp_path: Path) -> None:
    text, out = file.read_bytes(), tmp_path / "boxes.jpg"
    listed = json.loads(run_ok("info", file, "--json").stdout)
    assert [(b["id"], b["class"], b["thing"]) for b in listed["boxes"]] == [(2, "chair", True), (5, "wall", False)]
    assert "chair" in run_ok("info", file).stdout
    said = run_ok("info", file, "--picture", log, "--out", out).stdout
    assert out.read_bytes().startswith(b"\xff\xd8") and "1 of 2 boxes in view of its frames; written" in said
    color = np.array(ROOMS.colors[ROOMS.names.index("chair")])[::-1]
    tiles = np.asarray(cv2.imread(str(out)))[110 : 110 + 300, 24 : 24 + 3 * 512].astype(int)
    assert (np.abs(tiles - color).max(-1) < 30).sum() > 300
    for words in (("--picture", log), ("--out", tmp_path / "b.png")):
        refused("info", file, *words, code=2)
    (tmp_path / "boxes.png").symlink_to(file)
    said = refused("info", file, "--picture", log, "--out", tmp_path / "boxes.png")
    assert "the result is made from it" in said and file.read_bytes() == text
