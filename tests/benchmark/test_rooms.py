from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.benchmark.config import TIERS, SuiteConfig, settings_digest, suite_seeds
from semantic_mapper.benchmark.rooms import as_given, make_benchmark_room, query_pairs
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError
from semantic_mapper.scenes import TEST_SEEDS, VALIDATION_SEEDS
from tests.benchmark.tiny import tiny_room, tiny_suite


def test_truth_is_exact_where_the_sensor_is_not() -> None:
    room = tiny_room()
    assert len(room.frames) == 14 and room.queries == (6, 8) and room.pairs == ((6, 8),)
    for number, truth in room.truth.items():
        frame = room.frames[number]
        assert frame.depth_m is not None and frame.label is not None
        np.testing.assert_array_equal(truth.label, frame.label)
        seen = (frame.depth_m > 0) & (truth.depth_m > 0)
        error = np.abs(frame.depth_m - truth.depth_m)[seen]
        assert 0 < np.median(error) < 0.05
        assert (truth.depth_m > 0).sum() > (frame.depth_m > 0).sum()


def test_pairs_of_queries_are_spread_over_the_sequence() -> None:
    assert query_pairs(SuiteConfig()) == ((18, 22), (58, 62))
    with pytest.raises(ConfigError, match=r"raise sequence\.frames"):
        query_pairs(tiny_suite(sequence={"frames": 5, "query_pairs": 2, "pair_gap": 4}))


def test_a_split_gives_its_first_rooms() -> None:
    assert suite_seeds(SuiteConfig()) == list(TEST_SEEDS)
    assert suite_seeds(SuiteConfig(split="val", rooms=3)) == list(VALIDATION_SEEDS[:3])


def test_what_is_withheld_is_gone() -> None:
    frame = tiny_room().frames[0]
    bare = as_given(frame, depth=False)
    assert bare.depth_m is None and bare.label is None and bare.rgb is frame.rgb
    full = as_given(frame, depth=True, label=True)
    assert full.depth_m is frame.depth_m and full.label is frame.label


def test_records_are_told_apart_by_what_made_them_and_by_nothing_else() -> None:
    base = settings_digest(tiny_suite(), "views")
    assert settings_digest(tiny_suite(rooms=7, split="test"), "views") == base
    assert settings_digest(tiny_suite(map_frames=9), "views") == base
    assert settings_digest(tiny_suite(scene={"steps": 99}), "views") == base  # generalize fits nothing
    different = [
        settings_digest(tiny_suite(depth=False), "views"),
        settings_digest(tiny_suite(baseline="wide"), "views"),
        settings_digest(tiny_suite(protocol="finetune"), "views"),
        settings_digest(tiny_suite(protocol="scratch"), "views"),
        settings_digest(tiny_suite(protocol="scratch", scene={"steps": 99}), "views"),
        settings_digest(tiny_suite(), "map"),
        settings_digest(tiny_suite(map_frames=9), "map"),
    ]
    assert len({base, *different}) == 8
    assert settings_digest(tiny_suite(views=5), "map") == settings_digest(tiny_suite(), "map")


def test_the_cpu_tier_is_160_by_120() -> None:
    assert (TIERS["cpu"].width, TIERS["gpu"].width) == (160, 320)
    assert SuiteConfig().tier == TIERS["cpu"]


def test_the_camera_of_the_sequence_may_be_another():
    low = {"min_height_m": 0.5, "max_height_m": 0.7, "focal_per_width": 0.9, "sensor": "none"}
    suite = convert_config({"sequence": {"frames": 12, "query_pairs": 1, "camera": low}}, SuiteConfig, "test")
    room = make_benchmark_room(VALIDATION_SEEDS[0], suite)
    heights = [frame.T_world_camera[2, 3] for frame in room.frames]
    assert min(heights) > 0.45 and max(heights) < 0.75
    assert room.frames[0].intrinsics.fx == pytest.approx(0.9 * suite.tier.width) and room.frames[0].depth_m is None
    assert settings_digest(suite, "views") != settings_digest(SuiteConfig(), "views")
