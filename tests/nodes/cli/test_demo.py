"""``demo`` and ``doctor``: what somebody runs first."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from semantic_mapper.fields.checkpoint import default_checkpoint_path
from tests.nodes.support import run, run_process


@pytest.mark.slow  # 24 frames
def test_demo_ends_with_a_map_a_picture_and_a_summary(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = run("demo", "--out", out, "--voxel-size", "0.05", "--quality", "fast")
    assert done.returncode == 0, done.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"]["fused"] == summary["frames"]["published"] > 10
    assert summary["metrics"]["miou"] is not None
    for name in ("map.ply", "map.npz", "overview.png"):
        assert (out / name).stat().st_size > 0
        assert name in done.stdout
    assert "demo.mcap" in done.stdout


def test_doctor_finds_what_the_tests_themselves_need(tmp_path: Path) -> None:
    done = run_process("doctor", "--json", cwd=tmp_path)
    checks = {c["name"]: c for c in json.loads(done.stdout)}
    for name in ("packages", "Open3D", "torch", "sockets", "CPU", "disk"):
        assert checks[name]["state"] == "ok", checks[name]
    assert (checks["weights"]["state"] == "ok") == default_checkpoint_path().is_file()
    assert all(c["fix"] for c in checks.values() if c["state"] == "bad")
    assert done.returncode == int(any(c["state"] == "bad" for c in checks.values()))
