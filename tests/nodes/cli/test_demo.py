"""``demo``: what somebody runs first."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.nodes.support import run_ok, summary_of


@pytest.mark.slow  # 24 frames
def test_demo_ends_with_a_map_a_picture_and_a_summary(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    said = run_ok("demo", "--out", out, "--voxel-size", "0.05", "--quality", "fast").stdout
    summary = summary_of(out)
    assert summary["frames"]["fused"] == summary["frames"]["published"] > 10
    assert summary["metrics"]["miou"] is not None and "demo.mcap" in said
    for name in ("map.ply", "map.npz", "overview.png"):
        assert (out / name).stat().st_size > 0 and name in said
