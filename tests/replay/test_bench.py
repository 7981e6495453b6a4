from replay.bench import bench_render
from semantic_mapper.fields.checkpoint import Checkpoint
from tests.small import INTRINSICS, tiny_field


def test_bench_reports_ratios_of_renderers_that_agree():
    found = bench_render(Checkpoint(tiny_field()), repeats=1, view=INTRINSICS, reference_rays=64)
    assert found["speedup"] > 0 and found["speedup_at_equal_samples"] > 0
    assert found["max_logit_difference_at_equal_samples"] < 1e-3
    assert found["whole_view_rays"] == INTRINSICS.width * INTRINSICS.height
    assert 0 <= found["miou_streaming"] <= 1 and 0 <= found["miou_reference"] <= 1
    assert all(row["rays_per_s"] > 0 for row in found["renderers"].values()) and len(found["renderers"]) == 3
