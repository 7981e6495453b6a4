"""``import``, ``info`` and ``recover`` of logs; ``info`` of maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.mapping.rendered_views import small_map
from tests.mapping.test_voxel_map import fuse_sphere
from tests.nodes.support import run, run_ok
from tests.small import INTRINSICS, tiny_frames


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


def test_info_lists_the_missing_frames_of_each_camera(tmp_path: Path) -> None:
    """Frames that a recorder dropped, and a camera that stood still; another camera is whole."""
    whole, frames = tiny_frames(6), []
    for camera, seqs in (("left", (0, 1, 2, 6, 7, 9)), ("right", range(6))):
        frames += [
            replace(frame, camera_id=camera, seq=seq, stamp_ns=10**9 + seq * 10**8)
            for frame, seq in zip(whole, seqs, strict=True)
        ]
    frames.sort(key=lambda frame: frame.stamp_ns)
    log = tmp_path / "missing.mcap"
    with LogWriter(log, StreamInfo("test", {"left": INTRINSICS, "right": INTRINSICS}, ROOMS)) as writer:
        for frame in frames:
            writer.write_frame(frame)
    missing = json.loads(run("info", log, "--json").stdout)["missing_frames"]
    left = missing["left"]
    assert (left["frames_missing"], left["sequence_gap_count"], left["largest_sequence_gap"]) == (4, 2, 3)
    assert (left["time_gap_count"], left["longest_time_gap_s"], left["interval_s"]) == (1, 0.4, 0.1)
    assert left["largest_sequence_gap_after_seq"] == left["longest_time_gap_after_seq"] == 2
    assert missing["right"]["frames_missing"] == missing["right"]["time_gap_count"] == 0
    shown = " ".join(run("info", log).stdout.split())
    assert "missing frames left" in shown and "4 frames missing" in shown and "after seq 2" in shown


def test_info_of_a_map_says_what_it_is(tmp_path: Path) -> None:
    voxel_map = small_map(voxel_size_m=0.03)
    fuse_sphere(voxel_map, 3)
    path = tmp_path / "map.npz"
    voxel_map.save(path)
    done = run_ok("info", path)
    state = voxel_map.block_state()
    low, high = state["keys"].min(axis=0) * 0.24, (state["keys"].max(axis=0) + 1) * 0.24
    extent = " x ".join(f"{x:.2f}" for x in high - low)
    for text in ("version 3", "3, the last one at", "3 cm", extent, "72", "three: table, cup, wall"):
        assert text in done.stdout
    found = json.loads(run("info", path, "--json").stdout)
    assert (found["frames"], found["last_stamp_ns"], found["blocks"]) == (3, 1002, voxel_map.block_count)
    np.testing.assert_allclose(found["bounds_m"], [low, high])
    assert found["measured_voxels"] == (state["weight"] > 0).sum()
    assert found["voted_voxels"] == (state["votes"] > 0).sum()
    assert found["label_set"] == {"name": "three", "ids": [5, 9, 2], "classes": ["table", "cup", "wall"]}
    assert found["config"]["voxel_size_m"] == 0.03 and found["size_bytes"] == path.stat().st_size
