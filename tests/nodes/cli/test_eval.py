"""``eval --against``: what it prints and its exit codes, on folders that ``map`` has written."""

import json
import shutil
from pathlib import Path

from tests.nodes.support import refused, run, run_ok


def test_each_outcome_has_an_exit_code(replayed: Path, log: Path, weights: Path, config: Path, tmp_path: Path) -> None:
    copy, fewer = shutil.copytree(replayed, tmp_path / "copy"), tmp_path / "fewer"
    before = sorted(copy.iterdir())
    assert json.loads(run_ok("eval", replayed, "--against", copy, "--json").stdout)["equal"]
    assert sorted(copy.iterdir()) == before
    run_ok("map", log, "--out", fewer, "--weights", weights, "--config", config, "--max-frames", "5")
    done = run("eval", replayed, "--against", fewer)
    assert done.returncode == 1 and "different: frames.published, frames.fused" in done.stdout, done.stderr
    loose = (replayed / "map.npz", "--against", fewer / "map.npz", "--surface-m", "9", "--labels", "1")
    assert "is a map alone" in json.loads(run_ok("eval", *loose, "--json").stdout)["notes"][0]
    (copy / "map.npz").write_bytes((replayed / "map.npz").read_bytes()[:-100])
    for other, said in ((tmp_path / "gone", "no such map file"), (copy, "map.npz"), (log, "is a log; `semantic-")):
        assert said in refused("eval", replayed, "--against", other, code=2)
    assert run("eval", replayed, "--against", replayed, "--labels", "-1").returncode == 2
    for words, said in (
        ((replayed, copy, "--against", replayed), "compares one result"),
        ((replayed, "--against", replayed, "--out", tmp_path / "o.json"), "do not go with --against"),
        ((replayed, "--against", replayed, "--quality", "fast"), "settings of the mapper: goes with a LOG"),
        ((replayed, "--weights", weights), "--weights: goes with a LOG"),
        ((replayed, "--labels", "0.5"), "go with --against"),
    ):
        assert said in refused("eval", *words, code=2)
