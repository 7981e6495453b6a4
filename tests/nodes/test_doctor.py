"""``doctor``: this machine's packages and cameras."""

import json
from pathlib import Path

from semantic_mapper.fields.weights import default_checkpoint_path
from tests.contract.golden import form, undocumented
from tests.nodes.support import run, run_process


def test_it_finds_what_the_tests_themselves_need(tmp_path: Path) -> None:
    done = run_process("doctor", "--json", cwd=tmp_path)
    checks = {c["name"]: c for c in json.loads(done.stdout)}
    assert undocumented("doctor", form([*checks.values()])) == []
    for name in ("packages", "Open3D", "torch", "sockets", "CPU", "disk"):
        assert checks[name]["state"] == "ok", checks[name]
    assert (checks["weights"]["state"] == "ok") == default_checkpoint_path().is_file()
    assert all(c["fix"] for c in checks.values() if c["state"] == "bad")
    assert done.returncode == int(any(c["state"] == "bad" for c in checks.values()))


def test_cameras_are_listed_as_a_table_and_as_json() -> None:
    told = run("doctor", "--cameras", "--json")
    found = json.loads(told.stdout)
    assert undocumented("doctor", form(found)) == [] and set(found) == {"cameras", "unknown"}
    table = run("doctor", "--cameras")
    assert all(c["address"] in table.stdout for c in found["cameras"]) or "no camera is connected" in table.stdout
