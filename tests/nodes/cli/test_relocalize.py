"""``query MAP relocalize LOG``, as a command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.mapping.rendered_views import small_map
from tests.mapping.test_odometry_sessions import INTRINSICS, abroad, even, off, other_world, walk
from tests.nodes.support import refused, run


def test_a_map_that_cannot_be_found_again_is_refused_before_the_log_is_read(tmp_path: Path) -> None:
    small_map().save(tmp_path / "map.npz")
    (tmp_path / "bad.mcap").touch()
    assert "has nothing to find oneself by" in refused(
        "query", tmp_path / "map.npz", "relocalize", tmp_path / "bad.mcap"
    )


def test_the_frames_of_a_log_are_found_in_a_map_each_world_by_itself(tmp_path: Path) -> None:
    even().voxel_map.save(tmp_path / "map.npz")
    log_path = tmp_path / "today.mcap"
    with LogWriter(log_path, StreamInfo("today", {"rooms": INTRINSICS}, ROOMS, 4, 15.0)) as log:
        for frame in walk()[1:14:4]:
            log.write_frame(replace(abroad(frame, 0), label=None))
        log.write_frame(replace(walk()[15], world=2, label=None))
        data = log_path.stat().st_size
        log.write_frame(replace(walk()[15], world=2, label=None))
    whole = bytearray(log_path.read_bytes())
    whole[data + 5000] ^= 0xFF
    log_path.write_bytes(bytes(whole))
    found = run("query", tmp_path / "map.npz", "relocalize", log_path, "--json")
    assert found.returncode == 1, found.stderr
    told = json.loads(found.stdout)
    assert (told["frames"], told["found"], told["refused"]) == (5, 5, {})
    assert [frame["number"] for frame in told["unreadable"]] == [5]
    assert [(w["world"], w["agreeing"]) for w in told["sessions"]] == [(0, 4), (2, 1)]
    assert off(np.array(told["sessions"][0]["T_map_world"]) @ other_world(), np.eye(4))[0] < 0.1
    alone = told["sessions"][1]
    assert alone["T_map_world"] is None and alone["disagreement"] == "1 of 3 frames agree on it"
