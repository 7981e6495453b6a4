from __future__ import annotations

import numpy as np
import pytest

from research.scenes import TEST_SEEDS, VALIDATION_SEEDS
from research.suites.config import SuiteConfig, check_suite, settings_digest, suite_seeds
from research.suites.rooms import CLEAN, HARD, as_given, make_benchmark_room, query_pairs
from research.tests.suites.tiny import ROOM, tiny_room, tiny_suite
from semantic_mapper.errors import ConfigError


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
        settings_digest(tiny_suite(depth="off"), "views"),
        settings_digest(tiny_suite(depth="computed"), "views"),
        settings_digest(tiny_suite(sources="wide"), "views"),
        settings_digest(tiny_suite(sources="cover"), "views"),
        settings_digest(tiny_suite(own_image=False), "views"),
        settings_digest(tiny_suite(current="hard"), "views"),
        settings_digest(tiny_suite(protocol="finetune"), "views"),
        settings_digest(tiny_suite(protocol="scratch"), "views"),
        settings_digest(tiny_suite(protocol="scratch", scene={"steps": 99}), "views"),
        settings_digest(tiny_suite(), "map"),
        settings_digest(tiny_suite(map_frames=9), "map"),
    ]
    assert len({base, *different}) == 12
    assert settings_digest(tiny_suite(views=5), "map") == settings_digest(tiny_suite(), "map")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"sequence": {"camera": {"sensor": "none"}}}, "--depth off or computed"),
        ({"depth": "computed", "current": "hard"}, "needs a walk"),
    ],
)
def test_depth_that_there_cannot_be_is_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        check_suite(tiny_suite(**changes))


@pytest.mark.parametrize("seed", range(ROOM, ROOM + 5))
def test_hard_query_images_are_what_they_are_called_and_all_else_is_clean(seed: int) -> None:
    suite = tiny_suite(current="hard")
    clean, hard = make_benchmark_room(seed, tiny_suite()), make_benchmark_room(seed, suite)
    assert set(hard.condition.values()) <= set(HARD) and set(clean.condition.values()) == {CLEAN}
    assert not hard.pairs and all((a.rgb == b.rgb).all() for a, b in zip(clean.frames, hard.frames, strict=True))
    for query, kind in hard.condition.items():
        before, after = clean.frames[query], hard.current[query]
        assert after.label is not None and (after.label == hard.truth[query].label).all()
        if kind == "dark":
            assert after.rgb.mean() < 0.75 * before.rgb.mean()
        elif kind == "noise":
            assert roughness(after.rgb) > roughness(before.rgb)
        elif kind == "blur":
            assert roughness(after.rgb) <= roughness(before.rgb)  # equal where 48 pixels are too few to show it
            assert seed == ROOM + 4 or roughness(after.rgb) < roughness(before.rgb)
        elif kind == "narrow":
            assert after.intrinsics.fx == pytest.approx(1.4 * after.intrinsics.width)
        else:
            moved = np.linalg.norm(after.T_world_camera[:3, 3] - before.T_world_camera[:3, 3])
            h, w = hard.truth[query].exact_depth_m.shape
            middle = hard.truth[query].exact_depth_m[h // 2 - 3 : h // 2 + 3, w // 2 - 3 : w // 2 + 3]
            assert moved == 0 or middle.min() > 0.25
    conditions = {make_benchmark_room(s, suite).condition[q] for s in range(ROOM, ROOM + 5) for q in hard.queries[:1]}
    assert conditions == set(HARD)


def roughness(rgb: np.ndarray) -> float:
    return float(np.abs(np.diff(rgb.astype(np.float32), axis=1)).mean())
