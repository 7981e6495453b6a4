from __future__ import annotations

from pathlib import Path

import pytest

from research.bench import virtual as bench_virtual
from research.tests.evaluation.test_room_map import MAPPER
from semantic_mapper.config import MapperConfig, convert_config
from tests.nodes.support import write_weights


def test_virtual_views_are_compared_at_the_same_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_virtual, "FRAMES", 9)
    monkeypatch.setattr(bench_virtual, "COVERAGES", (bench_virtual.Coverage("few rendered", 1, 4, 2),))
    weights = write_weights(tmp_path / "tiny.safetensors")
    config = convert_config({**MAPPER, "keyframes": {"translation_m": 0.05}}, MapperConfig, "test")
    found = bench_virtual.bench_virtual(weights, config, rooms=1, views=2)
    rows = found["coverages"]["few rendered"]
    assert set(rows) == {"plain", "virtual", "finer", "more frames"}
    assert rows["plain"]["views"] == 0 and 0 < rows["virtual"]["views"] <= 2
    assert rows["plain"]["voted"] < min(rows["virtual"]["voted"], rows["more frames"]["voted"]) <= 1
    assert rows["virtual"]["cpu_s"] > rows["plain"]["cpu_s"] > 0
    for row in rows.values():
        assert 0 <= row["accuracy"] <= 1 and 0 <= row["ece"] <= 1 and 0 <= row["miou_where_plain_votes"] <= 1
