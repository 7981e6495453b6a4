from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semantic_mapper.bundle.picture_checks import PictureChecker
from semantic_mapper.bundle.refiner import PoseRefiner
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.types import UInt8

from .rooms import walk


def pictures() -> list[UInt8]:
    return [f.rgb for f in walk()[:12]]


def test_a_walk_of_sharp_pictures_gives_no_cause_for_complaint() -> None:
    checker = PictureChecker()
    assert [checker.look(rgb) for rgb in pictures()] == [()] * 12
    assert not checker.counters and checker.warnings == () and checker.reason == ""


@pytest.mark.parametrize("name", ["dark", "blurred", "exposure_jump"])
def test_what_is_wrong_with_a_picture_is_named_and_counted(name: str) -> None:
    checker = PictureChecker()
    for rgb in pictures()[:-1]:
        checker.look(rgb)
    last = pictures()[-1]
    spoiled = {
        "dark": last // 16,
        "blurred": cv2.blur(last, (41, 1)),
        "exposure_jump": np.clip(last.astype(int) * 2.5, 0, 255),
    }[name]
    assert name in checker.look(np.asarray(spoiled, np.uint8))
    assert checker.counters[name] == 1 and checker.warnings and checker.reason


def test_a_dim_picture_is_not_taken_for_a_blurred_one() -> None:
    checker = PictureChecker()
    for rgb in pictures():
        checker.look(rgb)
    assert "blurred" not in checker.look((pictures()[-1] * 0.5).astype(np.uint8))


def test_poses_that_move_while_the_picture_stands_still_are_named() -> None:
    refiner = PoseRefiner(PoseRefinerConfig())
    for frame in walk()[:4]:
        refiner.push(replace(frame, rgb=walk()[0].rgb))
    assert refiner.counters["still_pictures"] == 3
    assert any("the pictures do not" in text for text in refiner.warnings)


def test_poses_that_do_not_fit_the_pictures_are_named() -> None:
    right, wrong = PoseRefiner(PoseRefinerConfig()), PoseRefiner(PoseRefinerConfig())
    for number, frame in enumerate(walk()[:16]):
        right.push(frame)
        T = frame.T_world_camera.copy()
        T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.array((0.0, 0.03 * (-1) ** number, 0.0)))[0]
        wrong.push(replace(frame, T_world_camera=T))
    assert right.counters["misfit"] == 0
    assert wrong.counters["misfit"] > 3
