"""``doctor``: this machine's packages and cameras."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from semantic_mapper.fields.checkpoint import default_checkpoint_path
from semantic_mapper.nodes import doctor
from tests.nodes.support import refused, run, run_process


def test_it_finds_what_the_tests_themselves_need(tmp_path: Path) -> None:
    done = run_process("doctor", "--json", cwd=tmp_path)
    checks = {c["name"]: c for c in json.loads(done.stdout)}
    for name in ("packages", "Open3D", "torch", "sockets", "CPU", "disk"):
        assert checks[name]["state"] == "ok", checks[name]
    assert (checks["weights"]["state"] == "ok") == default_checkpoint_path().is_file()
    assert all(c["fix"] for c in checks.values() if c["state"] == "bad")
    assert done.returncode == int(any(c["state"] == "bad" for c in checks.values()))


def test_packages_are_checked_with_their_versions_and_without_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    requires = ["open3d<0.21,>=0.20", "torch>=2.5", "rich", 'rerun-sdk; extra == "viewer"', "no-such-package>=1"]
    versions = {"open3d": "0.21.0", "torch": "2.5.1+cpu", "rich": "13"}

    def version(name: str) -> str:
        if name not in versions:
            raise doctor.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requires)
    monkeypatch.setattr(doctor.metadata, "version", version)
    (told,) = doctor._packages()
    assert "open3d 0.21.0, not <0.21,>=0.20" in told.found and "no-such-package" in told.found
    assert "torch 2.5.1+cpu, not" not in told.found and "rerun-sdk" not in told.found


def test_cameras_are_listed_as_a_table_and_as_json() -> None:
    told = run("doctor", "--cameras", "--kind", "v4l2", "--kind", "opencv", "--json")
    found = json.loads(told.stdout)
    assert set(found) == {"cameras", "unknown"} and found["unknown"] == {}
    table = run("doctor", "--cameras", "--kind", "v4l2")
    assert all(c["address"] in table.stdout for c in found["cameras"]) or "no camera is connected" in table.stdout
    assert "did you mean 'v4l2'?" in refused("doctor", "--cameras", "--kind", "v4l")
