"""``doctor --cameras``: what is connected, for people and for programs."""

from __future__ import annotations

import json

from tests.nodes.support import error_line, run


def test_it_lists_what_is_connected_as_a_table_and_as_json() -> None:
    told = run("doctor", "--cameras", "--kind", "v4l2", "--kind", "opencv", "--json")
    assert told.returncode == 0, told.stderr
    found = json.loads(told.stdout)
    assert set(found) == {"cameras", "unknown"} and found["unknown"] == {}
    table = run("doctor", "--cameras", "--kind", "v4l2")
    assert table.returncode == 0
    assert all(c["address"] in table.stdout for c in found["cameras"]) or "no camera is connected" in table.stdout


def test_an_unknown_kind_is_told_with_the_nearest() -> None:
    done = run("doctor", "--cameras", "--kind", "v4l")
    assert done.returncode == 1 and "did you mean 'v4l2'?" in error_line(done.stderr)
