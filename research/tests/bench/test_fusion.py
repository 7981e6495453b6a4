"""What ``bench fusion`` measures, on a frame of the log that ships."""

from __future__ import annotations

import pytest

from research.bench.fusion import bench_fusion
from semantic_mapper.replay.log import demo_log


def test_fusion_is_measured_against_open3d() -> None:
    found = bench_fusion(demo_log(), frames=1, voxel_size_m=0.08)
    assert found["ratio_20"] == pytest.approx(found["ms_20"] / found["open3d_ms"], rel=0.1)
    assert found["ratio_40"] > 0 and found["frames"] == 1
    assert found["blocks"] >= 0.9 * found["open3d_blocks"] > 0  # Open3D looks at every fourth pixel
