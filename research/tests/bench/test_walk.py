"""The long walk, short: rooms come back as they were left, memory keeps its limit, figures are those of the run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

import research.bench.plots as plots_module
import research.bench.walk as bench_walk_module
from research.bench.plots import draw_walk
from research.bench.walk import WalkPlan, bench_walk
from research.plots import Panel
from semantic_mapper.mapping.block_grid import LEAST_RESIDENT
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import MapUpdate, PosedFrame
from tests.nodes.support import write_weights
from tests.small import tiny_config, tiny_field

PLAN = WalkPlan(rooms=3, returns=2, minutes=1.0, hz=0.5, width=96)
MEMORY_MB = 18  # 517 blocks of 5 cm voxels, where a room has some 700
CONFIG = tiny_config(
    render={"encode_width": 96, "scale": 0.25},
    voxel_map={"voxel_size_m": 0.05, "memory_mb": MEMORY_MB},
    keyframes={"source_views": 2},
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_weights(tmp_path_factory.mktemp("walk") / "tiny.safetensors")


def test_rooms_come_back_unchanged_and_memory_keeps_its_limit(weights: Path) -> None:
    done: list[int] = []
    found = bench_walk(weights, CONFIG, PLAN, done.append)
    assert PLAN.frames == 30 and done == list(range(1, 31))
    assert found["returns_unchanged"] == found["returns"] == 2
    resident = 1e6 * MEMORY_MB / (2 * 512 * (found["classes"] + 12) + 12)
    assert LEAST_RESIDENT < found["blocks_in_memory_at_most"] <= resident
    assert found["blocks_on_disk"] > 500 and found["store_mb"] > 1
    at_most = found["minute_blocks_in_memory"][-1] + found["minute_blocks_on_disk"][-1]
    assert resident < found["blocks"] <= at_most
    block_mb = 2e-6 * 512 * (found["classes"] + 12)
    assert 100 * block_mb < found["frame_mb_at_most"] < resident * block_mb, "this walk's frames fit"
    assert found["memory_advised_mb"] == pytest.approx(1.5 * found["frame_mb_at_most"], abs=1.1)
    assert 0 < found["fuse_p50_ms"] < found["step_p50_ms"] <= found["step_p95_ms"]
    assert found["return_cpu_ratio"] > 0
    short = ("rss_growth_mb", "rss_minute_5_mb", "step_slope_percent_a_minute", "cpu_p50_last_ten_minutes_ms")
    assert all(found[name] is None for name in short), "too short a walk to tell"
    assert found["rss_max_mb"] >= found["rss_last_minute_mb"] > 50
    assert {len(values) for name, values in found.items() if name.startswith("minute_")} == {1}
    assert draw_walk({**found, "minute_step_p50_ms": [1.0, 2.0, 3.0]}).shape[1] > 1000


def test_a_walk_with_less_memory_than_one_frame_takes_comes_to_its_end(weights: Path) -> None:
    config = tiny_config(
        render={"encode_width": 96, "scale": 0.25},
        voxel_map={"voxel_size_m": 0.02, "memory_mb": 1},
        keyframes={"source_views": 2},
    )
    plan = WalkPlan(rooms=1, returns=1, minutes=0.1, hz=0.5, width=160)
    found = bench_walk(weights, config, plan)
    assert found["frame_mb_at_most"] > 3 * LEAST_RESIDENT * 2e-6 * 512 * found["classes"]
    assert found["memory_advised_mb"] >= found["frame_mb_at_most"]
    assert found["blocks_in_memory_at_most"] == LEAST_RESIDENT
    assert (
        found["blocks"]
        == bench_walk(weights, replace(config, voxel_map=replace(config.voxel_map, memory_mb=0)), plan)["blocks"]
    )


def test_a_room_that_was_touched_meanwhile_is_told_of(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of the last room are moved to where the first one lies."""
    step = MappingPipeline.step

    def misplaced(self: MappingPipeline, frame: PosedFrame) -> MapUpdate:
        if frame.T_world_camera[1, 3] > 10:
            frame.T_world_camera[1, 3] -= 13.0  # room 2 stands in the second row of cells, above room 0
        return step(self, frame)

    monkeypatch.setattr(bench_walk_module.MappingPipeline, "step", misplaced)
    assert bench_walk(weights, CONFIG, PLAN)["returns_unchanged"] == 1


def test_what_comes_back_is_what_a_map_without_a_limit_holds() -> None:
    """The same walk, fused with and without paging."""
    whole, paged = (
        VoxelMap(tiny_config(voxel_map={"voxel_size_m": 0.05, "memory_mb": mb}).voxel_map, tiny_field().label_set)
        for mb in (0, MEMORY_MB)
    )
    for visit in PLAN.visits():
        for frame in visit.frames:
            assert frame.depth_m is not None
            rows = (frame.label % len(whole.label_set)).astype(np.int32) if frame.label is not None else None
            votes = 0.9 * np.eye(len(whole.label_set), dtype=np.float32) + np.float32(0.1 / len(whole.label_set))
            for voxel_map in (whole, paged):
                voxel_map.integrate(frame, frame.depth_m, votes / votes.sum(axis=1, keepdims=True), rows=rows)
        keys = whole.changes(0).keys * 0.4  # metres
        assert (((keys > visit.low - 0.4) & (keys < visit.high)).all(axis=1)).any()
    assert paged.stored_blocks > 500
    one, other = whole.block_state(), paged.block_state()
    assert all(one[name].tobytes() == other[name].tobytes() for name in one)
    some = one["keys"][::7]
    assert paged.block_state(some)["evidence"].tobytes() == one["evidence"][::7].tobytes()


def drawn_panels(monkeypatch: pytest.MonkeyPatch) -> list[Panel]:
    """Filled with the panels that are drawn."""
    panels: list[Panel] = []
    monkeypatch.setattr(plots_module, "draw_panels", lambda title, drawn: panels.extend(drawn))
    return panels


def test_memory_is_told_where_it_has_settled_and_where_it_was_most(monkeypatch: pytest.MonkeyPatch) -> None:
    rss = [300.0, 310, 320, 330, 340, 400, 410, 450, 430]
    found = bench_walk_module._memory(rss, 100)
    levels = ("rss_minute_5_mb", "rss_max_after_minute_5_mb", "rss_max_mb")
    assert [found[name] for name in levels] == [400, 450, 450]
    assert (found["rss_growth_mb"], found["rss_growth_percent_of_limit"]) == (30, 30)
    assert bench_walk_module._memory([500.0, *rss], 0)["rss_max_mb"] == 500
    figures = {name: [1.0] * 9 for name in ("step_p95_ms", "step_p50_ms", "fuse_p50_ms")}
    figures |= {name: [0.0] * 9 for name in ("blocks_on_disk", "blocks_in_memory")}
    walk = {"rooms": 1, "minutes": 9.0, "hz": 1.0, "size": "96x72", "minute_rss_mb": rss, **found}
    walk |= {f"minute_{name}": values for name, values in figures.items()}
    panels = drawn_panels(monkeypatch)
    draw_walk(walk)
    levels = {curve.name: list(curve.points) for curve in panels[1].curves}
    assert levels["minute 5"] == [(5, 400), (8, 400)] and levels["most after it"] == [(5, 450), (8, 450)]
    assert levels["each minute"] == list(enumerate(rss))
