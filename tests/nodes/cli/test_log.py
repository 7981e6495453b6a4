"""``import``, ``info`` and ``recover`` of logs; ``info`` of maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import run, run_ok


def test_recording_with_a_broken_pose_is_imported_but_for_that_frame(log: Path, tmp_path: Path) -> None:
    source, new = tmp_path / "sequence", tmp_path / "sequence.mcap"
    run_ok("export", log, "--out", source, "--format", "folder", "--max-frames", "4")
    poses = (source / "poses.txt").read_text().splitlines()
    poses[2] = " ".join(["nan"] * 16)
    (source / "poses.txt").write_text("\n".join(poses))
    said = run_ok("import", source, new).stdout
    assert "3 frames (3 of them labelled)" in said and "frame 2" in said and "poses.txt" in said
    found = json.loads(run("info", new, "--json").stdout)
    assert found["frames"] == found["frames_with_depth"] == found["frames_with_labels"] == 3
    assert [c["width"] for c in found["cameras"].values()] == [96] and found["damage"] == []


def test_info_shows_topics_frames_and_classes(log: Path) -> None:
    done = run_ok("info", log)
    for text in ("6 (6 with depth, 6 with labels)", "96x72", "topic frame/rooms", "rooms: wall, floor", "none"):
        assert text in done.stdout


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
