"""``relocalize``, as a command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.mapping.test_worlds import INTRINSICS, abroad, even_map, off, other_world, walk
from tests.nodes.support import run


def test_the_frames_of_a_log_are_found_in_a_map(tmp_path: Path) -> None:
    even_map().save(tmp_path / "map.npz")
    with LogWriter(tmp_path / "today.mcap", StreamInfo("today", {"rooms": INTRINSICS}, ROOMS, 4, 15.0)) as log:
        for frame in walk()[1:14:4]:
            log.write_frame(replace(abroad(frame, 0), label=None))
    found = run("relocalize", tmp_path / "map.npz", tmp_path / "today.mcap", "--json")
    assert found.returncode == 0, found.stderr
    told = json.loads(found.stdout)
    assert (told["frames"], told["found"], told["refused"]) == (4, 4, {})
    assert off(np.array(told["T_map_world"]) @ other_world(), np.eye(4))[0] < 0.1
