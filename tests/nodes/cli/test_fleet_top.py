"""``fleet top``: runs as their drivers report them."""

from __future__ import annotations

import json
import time
from pathlib import Path

import msgspec

from semantic_mapper.nodes.fleet.runner import DriverStatus
from semantic_mapper.nodes.fleet.store import Store
from tests.nodes.support import run


def status(name: str) -> DriverStatus:
    now = time.time_ns()
    return DriverStatus(name, "host", 7, "replay", "0.1.0", "local", 10, 4, 0, 1, 0, 0, 0.5, None, now, now, "done")


def test_documents_that_cannot_be_read_are_skipped_with_a_warning(tmp_path: Path) -> None:
    store = Store(str(tmp_path), create=True)
    store.write("drivers/20260101T000000-aaaaaa.json", msgspec.json.encode(status("20260101T000000-aaaaaa")))
    store.write("drivers/20260102T000000-bbbbbb.json", b'{"id": "half a docu')
    newer = {**msgspec.to_builtins(status("20260103T000000-cccccc")), "total": {"logs": 10}}
    store.write("drivers/20260103T000000-cccccc.json", msgspec.json.encode(newer))
    done = run("fleet", "top", store.url, "--json")
    assert done.returncode == 0, done.stderr
    assert [driver["id"] for driver in json.loads(done.stdout)["drivers"]] == ["20260101T000000-aaaaaa"]
    assert "Traceback" not in done.stderr
    assert done.stderr.count("bbbbbb.json") == 1 and done.stderr.count("cccccc.json") == 1
    done = run("fleet", "top", store.url)
    assert done.returncode == 0 and "20260101T000000-aaaaaa" in done.stdout, done.stderr
