"""What ``bench`` measures, on a few frames of the log that ships."""

from __future__ import annotations

import pytest

from semantic_mapper.config import MapperConfig, with_quality
from semantic_mapper.replay.bench import bench_fusion, bench_pipeline
from semantic_mapper.replay.log import demo_log
from tests.contract.golden import form, undocumented


def test_fusion_is_measured_against_open3d() -> None:
    found = bench_fusion(demo_log(), frames=1, voxel_size_m=0.08, repeats=2)
    middle, low, high = found["ratio_20"]
    assert low <= middle <= high and middle == pytest.approx(found["ms_20"] / found["open3d_ms"], rel=0.5)
    assert min(found["ratio_40"]) > 0 and found["frames"] == 1
    assert found["blocks"] >= 0.9 * found["open3d_blocks"] > 0  # Open3D looks at every fourth pixel


def test_pipeline_reports_its_rate_its_stages_and_what_the_labels_are_worth() -> None:
    found = bench_pipeline(demo_log(), None, with_quality(MapperConfig(quality="fast")), frames=1)
    assert undocumented("bench", form(found)) == []
    assert found["hz"] > 0 and found["p95_ms"] >= found["p50_ms"]
    assert {"encode", "render", "fuse"} <= set(found["stages_ms"])
    assert sum(found["stages_ms"].values()) <= found["p95_ms"] * 1.05
    assert 0.1 < found["miou"] <= 1
