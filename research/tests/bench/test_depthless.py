from __future__ import annotations

from pathlib import Path

from research.bench.depthless import bench_depthless
from research.tests.evaluation.test_room_map import MAPPER
from semantic_mapper.config import MapperConfig, convert_config
from tests.nodes.support import write_weights


def test_surfaces_are_compared_by_how_many_frames_have_depth(tmp_path: Path) -> None:
    weights = write_weights(tmp_path / "tiny.safetensors")
    every, few, none = bench_depthless(weights, convert_config(MAPPER, MapperConfig, "test"), frames=8)
    assert [row["with_depth"] for row in (every, few, none)] == [8, 2, 0]
    assert every["median_m"] < 0.02 and every["precise"] > 0.95
    assert every["complete"] > few["complete"] > 0
