import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from research.train.ranks import Ranks, ranks_from_environment
from semantic_mapper.errors import ConfigError

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_two_processes_hold_the_same_weights_and_see_different_rooms(tmp_path: Path):
    starter = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*starter, str(ROOT / "research" / "tests" / "train" / "two_ranks.py"), str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    weights, about = [], []
    for rank in range(2):
        with safe_open(tmp_path / f"rank{rank}.safetensors", framework="pt") as stored:
            weights.append({name: stored.get_tensor(name) for name in stored.keys()})  # noqa: SIM118
            about.append(stored.metadata())
    assert [n for n in weights[0] if not torch.equal(weights[0][n], weights[1][n])] == []
    rooms = [set(a["rooms"].split()) for a in about]
    assert rooms[0] and rooms[1] and not rooms[0] & rooms[1]
    assert about[0]["score"] == about[1]["score"] != "None"
    assert about[0]["ranks"] == "2"
    assert {p.name for p in tmp_path.iterdir()} >= {"state.safetensors", "history.jsonl", "weights.safetensors"}


def test_without_torchrun_there_is_one_rank(monkeypatch: pytest.MonkeyPatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    assert ranks_from_environment() == Ranks(0, 1, 0)
    assert Ranks().first and Ranks().largest(0.5, 1.0) == (0.5, 1.0)
    monkeypatch.setenv("WORLD_SIZE", "two")
    with pytest.raises(ConfigError, match="must be whole numbers"):
        ranks_from_environment()
