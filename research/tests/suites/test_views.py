from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from research.suites.config import SpacingConfig
from research.suites.views import choose_as_mapper, choose_covering, choose_sources
from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(40.0, 40.0, 23.5, 15.5, 48, 32)
WALL = np.full((32, 48), 2.0, np.float32)  # 2 m ahead, 2.4 m wide


def frame(x: float, *, turned: bool = False) -> PosedFrame:
    """A camera ``x`` metres to the right that looks at the wall, or away from it."""
    T = np.eye(4)
    if turned:
        T[0, 0] = T[2, 2] = -1
    T[0, 3] = x
    rgb = np.zeros((32, 48, 3), np.uint8)
    return PosedFrame(0, 0, "test", rgb, WALL, None, CAMERA, T)


def choose(candidates: list[PosedFrame], count: int, from_query_m: float, apart_m: float):
    return choose_sources(np.eye(4), WALL, candidates, count, SpacingConfig(from_query_m=from_query_m, apart_m=apart_m))


def test_narrow_views_are_near_even_where_farther_ones_see_more() -> None:
    back = frame(0.3)
    back.T_world_camera[2, 3] = -2.0  # sees the whole wall from 4 m
    far = dataclasses.replace(back, depth_m=np.full_like(WALL, 4.0))
    assert choose([far, frame(0.4)], 1, 0.0, 0.0).numbers == (0,)
    bounded = choose_sources(np.eye(4), WALL, [far, frame(0.4)], 1, SpacingConfig(to_query_m=0.5))
    assert bounded.numbers == (1,)


def test_wide_views_keep_their_distance_from_the_query_and_from_each_other() -> None:
    candidates = [frame(x) for x in (0.1, 0.2, 0.5, 0.55, 0.75, -0.6)]
    found = choose(candidates, 3, 0.5, 0.2)
    assert set(found.numbers) == {2, 5, 4}


def test_covering_views_add_to_each_other_and_labelled_ones_count_twice() -> None:
    left, near, right = frame(-0.6), frame(-0.55), frame(0.6)
    found = choose_covering(np.eye(4), WALL, [left, near, right, frame(0.0, turned=True)], [False] * 4, 2)
    assert set(found.numbers) == {1, 2}, "not both from the left"
    assert found.seen > 0.95
    assert found.distance_m == pytest.approx(0.575)
    assert choose_covering(np.eye(4), WALL, [left, near, right], [True, False, False], 1).numbers == (0,)


def test_the_choice_of_the_mapper_takes_keyframes_of_the_past_that_cover_the_query() -> None:
    past = [frame(0.01 * n) for n in range(30)] + [frame(0.0, turned=True), frame(0.9)]
    found = choose_as_mapper(past, frame(0.3), WALL, 8)
    moves = [past[i].T_world_camera[0, 3] for i in found.numbers]
    assert 30 not in found.numbers, "it looks away"
    assert 1 < len(moves) <= 8 and all(abs(a - b) > 0.05 for a in moves for b in moves if a != b), "keyframes are apart"
    assert found.seen == pytest.approx(1) and 0 < found.distance_m < 1
    lonely = choose_as_mapper([frame(0.0, turned=True)], frame(0.0), WALL, 3)
    assert lonely.numbers == (0,) and lonely.seen == 0
