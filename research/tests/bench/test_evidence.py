from __future__ import annotations

from pathlib import Path

import pytest

from research.bench import virtual as bench_virtual
from research.bench.evidence import bench_evidence
from research.tests.evaluation.test_room_map import MAPPER
from semantic_mapper.config import MapperConfig, convert_config
from tests.nodes.support import write_weights


def test_kinds_of_evidence_are_compared_on_the_same_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_virtual, "FRAMES", 5)
    weights = write_weights(tmp_path / "tiny.safetensors")
    kinds = bench_evidence(weights, convert_config(MAPPER, MapperConfig, "test"), rooms=1)["kinds"]
    floats, compact = kinds["float32"], kinds["int16"]
    assert 0 < compact["block_kib"] < 0.75 * floats["block_kib"]
    for name in ("miou", "accuracy", "ece"):
        assert compact[name] == pytest.approx(floats[name], abs=0.01) and 0 <= floats[name] <= 1
