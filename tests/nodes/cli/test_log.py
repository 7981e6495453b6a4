"""``info`` of maps and boxes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import run_ok


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


def test_boxes_are_listed(tmp_path: Path) -> None:
    boxes = [
        {"id": 2, "class": "chair", "T_world_box": np.eye(4).tolist(), "size": [0.3, 0.3, 0.4]},
        {"id": 5, "class": "wall", "T_world_box": np.eye(4).tolist(), "size": [1, 1, 2]},
    ]
    (file := tmp_path / "boxes.json").write_text(json.dumps({"boxes": boxes}))
    listed = json.loads(run_ok("info", file, "--json").stdout)
    assert [(b["id"], b["class"], b["thing"]) for b in listed["boxes"]] == [(2, "chair", True), (5, "wall", False)]
    assert "chair" in run_ok("info", file).stdout
