"""``compare``: what it prints and its exit codes, on folders that ``replay`` has written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from tests.nodes.support import error_line, run


def test_a_copy_is_equal_to_the_byte_and_a_run_without_a_frame_differs(
    replayed: Path, log: Path, weights: Path, config: Path, tmp_path: Path
) -> None:
    copy = shutil.copytree(replayed, tmp_path / "copy")
    done = run("compare", replayed, copy, "--exact", "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["equal"], done.stderr
    fewer = tmp_path / "fewer"
    run("replay", log, "--out", fewer, "--weights", weights, "--config", config, "--max-frames", "5")
    done = run("compare", replayed, fewer)
    assert done.returncode == 1 and "different: frames.published, frames.fused" in done.stdout, done.stderr
    maps = replayed / "map.npz", fewer / "map.npz"
    loose = ("--surface-m", "9", "--labels", "1")
    done = run("compare", *maps, *loose, "--json")
    assert done.returncode == 0 and "is a map alone" in json.loads(done.stdout)["notes"][0]
    done = run("compare", *maps, *loose, "--exact")
    assert done.returncode == 1 and "different: other bytes" in done.stdout


def test_what_cannot_be_compared_is_no_difference(replayed: Path, log: Path, tmp_path: Path) -> None:
    done = run("compare", replayed, tmp_path / "gone")
    assert done.returncode == 2 and "no such map file" in error_line(done.stderr)
    broken = shutil.copytree(replayed, tmp_path / "broken")
    (broken / "map.npz").write_bytes((replayed / "map.npz").read_bytes()[:-100])
    done = run("compare", broken, replayed)
    assert done.returncode == 2 and "map.npz" in error_line(done.stderr)
    done = run("compare", replayed, log)
    assert done.returncode == 2 and "is a log; `semantic-mapper replay" in error_line(done.stderr)
    assert run("compare", replayed, replayed, "--labels", "-1").returncode == 2
