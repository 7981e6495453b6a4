"""``semantic-mapper-research bench map`` as people run it."""

from __future__ import annotations

import json
from pathlib import Path

from research.tests.cli.support import run
from tests.nodes.support import error_line

SMALL = ("--rooms", "2", "--loops", "1", "--minutes", "0.2", "--hz", "1", "--width", "96")


def test_a_small_walk_is_measured_written_and_drawn(tmp_path: Path, weights: Path, config: Path) -> None:
    file, plot = tmp_path / "bench.json", tmp_path / "bench.png"
    options = ("--weights", weights, "--config", config, "--memory-mb", "30", "--out", file, "--plot", plot)
    done = run("bench", "map", *SMALL, *options)
    assert done.returncode == 0, done.stderr
    assert "1 of 1 rooms unchanged" in done.stdout
    assert "too short for a slope" in done.stdout.replace("\n", " ") and "% a minute" not in done.stdout
    found = json.loads(file.read_text(encoding="utf-8"))
    assert found["frames"] == 12 and found["memory_mb"] == 30
    assert found["step_p50_ms"] > 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    done = run("bench", "map", *SMALL, "--loops", "5", "--weights", weights, "--config", config)
    assert done.returncode == 1 and "returns" in error_line(done.stderr), "a walk that does not return"
