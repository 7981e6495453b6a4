from __future__ import annotations

import cv2
import numpy as np
import pytest

from semantic_mapper.mapping.picture_check import PictureQuality
from semantic_mapper.types import UInt8
from tests.bundle.rooms import walk

PICTURES: list[UInt8] = [f.rgb for f in walk()[:12]]


def test_a_walk_of_sharp_pictures_gives_no_cause_for_complaint_and_a_dim_one_is_not_blurred() -> None:
    checker = PictureQuality()
    assert [checker.look(rgb) for rgb in PICTURES] == [()] * 12
    assert not checker.counters and checker.warnings == ()
    assert "blurred" not in checker.look((PICTURES[-1] * 0.5).astype(np.uint8))


@pytest.mark.parametrize("name", ["dark", "blurred", "exposure_jump"])
def test_what_is_wrong_with_a_picture_is_named_and_counted(name: str) -> None:
    checker = PictureQuality()
    for rgb in PICTURES[:-1]:
        checker.look(rgb)
    last = PICTURES[-1]
    spoiled = {
        "dark": last // 16,
        "blurred": cv2.blur(last, (41, 1)),
        "exposure_jump": np.clip(last.astype(int) * 2.5, 0, 255),
    }[name]
    assert name in checker.look(np.asarray(spoiled, np.uint8))
    assert checker.counters[name] == 1 and checker.warnings
