from dataclasses import replace

import numpy as np
import pytest
import torch

import research.bench.render as bench
from research.bench.render import bench_render, log_scenes, room_scenes
from semantic_mapper.errors import LogError
from semantic_mapper.fields.checkpoint import Checkpoint, streaming
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.rendering import ViewRenderer
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.small import INTRINSICS, tiny_config, tiny_field, tiny_frames


def test_bench_reports_ratios_of_renderers_that_agree():
    found = bench_render(Checkpoint(tiny_field()), room_scenes(2, INTRINSICS), repeats=1, reference_rays=64)
    assert found["views"] == 2
    assert found["max_logit_difference_at_equal_samples"] < 1e-3
    renderers = found["renderers"]
    assert len(renderers) == (5 if bench.find_gpu() is None else 7)
    assert all(row["pixels_per_s"] > 0 and 0 <= row["miou"] <= 1 for row in renderers.values())
    assert renderers["eager, 8 guided samples"]["miou"] == renderers["streaming, 8 guided samples"]["miou"]
    assert found["miou_reference"] == renderers["reference, 64 + 64 samples"]["miou"]
    wall = {name.split(",")[-1].split()[-1]: row["view_wall_s"] for name, row in renderers.items()}
    assert found["speedup_fast"] > 0 and found["speedup_all_rays"] > 0 and wall["fast"] > 0


def test_the_renderer_is_asked_as_the_mapper_asks_it(monkeypatch: pytest.MonkeyPatch):
    asked, render = [], ViewRenderer.render

    def recorded(self, view, rgb, **rest):
        asked.append((view.prior_depth_m, view.measured))
        return render(self, view, rgb, **rest)

    monkeypatch.setattr(ViewRenderer, "render", recorded)
    (scene,) = room_scenes(1, INTRINSICS)
    holes = np.array(scene.query.depth_m)
    holes[20:40, 30:60] = 0
    scene = replace(scene, query=replace(scene.query, depth_m=holes))
    config = tiny_config(render={"scale": 1.0})
    MappingPipeline(config, streaming(tiny_field(), config.sampling), ROOMS).step(scene.query)
    bench_render(Checkpoint(tiny_field()), [scene], repeats=0, reference_rays=64)
    (prior, measured), *others = asked
    assert len(others) == 2 and 0 < measured.mean() < 1
    assert all(np.array_equal(prior, p) and np.array_equal(measured, m) for p, m in others)


@pytest.mark.slow
def test_a_gpu_has_rows_of_its_own(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bench, "find_gpu", lambda: torch.device("cpu"))
    found = bench_render(Checkpoint(tiny_field()), room_scenes(1, INTRINSICS), repeats=1, reference_rays=640)
    gpu, rounded, cpu = (found["renderers"][bench.LONG_NAMES[name]] for name in ("gpu", "gpu_bfloat16", "streaming"))
    assert gpu["miou"] == pytest.approx(cpu["miou"], abs=0.02)
    assert rounded["miou"] == pytest.approx(cpu["miou"], abs=0.1) and rounded["pixels_per_s"] > 0


def test_views_of_a_log_are_rendered_from_the_frames_round_them(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path, StreamInfo("test", {"rooms": INTRINSICS}, ROOMS)) as writer:
        for frame in tiny_frames(14):
            writer.write_frame(frame)
    scenes = log_scenes(path, 2, step=1)
    assert [s.query.seq for s in scenes] == [4, 9]
    assert [f.seq for f in scenes[0].sources] == [0, 1, 2, 3, 5, 6, 7, 8]
    with pytest.raises(LogError, match="2 scenes need 42 frames, the log has 14"):
        log_scenes(path, 2)
