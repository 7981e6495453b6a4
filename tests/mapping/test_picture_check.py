"""Contradictions between pictures and poses: each is named where it is, and none where all is well."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from research.experiments.picture_faults import BEGIN, FAULTS, named, room_walk, spoil
from research.scenes import TRAIN_SEEDS
from semantic_mapper.errors import FrameError
from semantic_mapper.mapping.picture_check import SENTENCES, PictureCheck
from semantic_mapper.types import PosedFrame
from tests.small import tiny_pipeline

SEED = TRAIN_SEEDS[7]


@cache
def walk() -> tuple[PosedFrame, ...]:
    return tuple(room_walk(SEED, count=BEGIN + 24))


def test_a_walk_without_faults_gives_no_cause_for_complaint() -> None:
    check = PictureCheck()
    assert [check.look(frame) for frame in walk()] == [""] * len(walk())
    assert not check.counters and check.warnings == () and check.notes == [] and check.checked == len(walk())


@pytest.mark.parametrize("fault", [name for name, (what, _) in FAULTS.items() if what != "focal_change"])
def test_a_fault_is_named(fault: str) -> None:
    counters, _ = named(spoil(walk(), fault))
    what, most = FAULTS[fault]
    assert 1 <= counters[what] <= most


def test_a_warning_ends_with_its_cause_and_the_count_stays() -> None:
    check = PictureCheck()
    for frame in spoil(walk()[:BEGIN], "none"):
        check.look(frame)
    assert "too dark" in check.look(replace(walk()[BEGIN], rgb=walk()[BEGIN].rgb // 16))
    assert check.warnings == (SENTENCES["dark"],)
    for n in range(30):
        check.look(replace(walk()[BEGIN + n % 20], camera_id="another"))
    assert check.warnings == () and check.counters["dark"] == 1 and "1 of" in check.notes[0]


def test_a_camera_of_another_lens_is_judged_from_its_first_picture_on() -> None:
    check = PictureCheck()
    for n, frame in enumerate(walk()[:20]):
        wider = replace(frame.intrinsics, fx=200.0, fy=200.0)
        check.look(replace(frame, intrinsics=wider) if n % 2 else frame)
    assert check.counters["focal_change"] == 0


def test_a_picture_that_would_spoil_the_map_is_refused_and_the_next_one_is_welcome() -> None:
    pipeline = tiny_pipeline(render={"encode_width": 96, "scale": 0.25})
    for frame in walk()[:6]:
        pipeline.step(frame)
    before = pipeline.voxel_map.block_count
    with pytest.raises(FrameError, match="seq=6 of camera 'camera': pictures are too dark"):
        pipeline.step(replace(walk()[6], rgb=walk()[6].rgb // 16))
    assert pipeline.voxel_map.block_count == before and pipeline.picture_check.counters["dark"] == 1
    pipeline.step(walk()[7])
