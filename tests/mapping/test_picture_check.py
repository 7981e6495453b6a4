"""Contradictions between pictures and poses: each is named where it is, and none where all is well."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from research.scenes import TRAIN_SEEDS, CameraPathConfig, NoiseConfig, room_frames
from semantic_mapper.errors import FrameError
from semantic_mapper.mapping.picture_check import SENTENCES, PictureCheck
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.small import tiny_pipeline

SEED = TRAIN_SEEDS[7]
CAMERA = CameraIntrinsics(272.0, 272.0, 159.5, 119.5, 320, 240)
BEGIN, LENGTH, COUNT = 20, 20, 44  # of the fault, and of the walk
# What should be said of a fault, and of how many pictures at most.
FAULTS = {
    "dark": ("dark", LENGTH),
    "blur": ("blurred", LENGTH // 4),
    "flicker": ("exposure_jump", LENGTH),
    "frozen": ("still_pictures", LENGTH),
    "late poses": ("misfit", COUNT),
}


@cache
def walk() -> tuple[PosedFrame, ...]:
    path, noise = CameraPathConfig(step_m=0.04), NoiseConfig(depth="none")
    return tuple(room_frames(SEED, COUNT, CAMERA, path=path, noise=noise))


def spoiled(n: int, fault: str) -> PosedFrame:
    frame = walk()[n]
    if fault == "late poses":
        return replace(frame, T_world_camera=walk()[max(n - 4, 0)].T_world_camera)
    if not BEGIN <= n < BEGIN + LENGTH:
        return frame
    rgb = frame.rgb
    if fault == "dark":
        rgb = rgb // 16
    elif fault == "frozen":
        rgb = walk()[BEGIN].rgb
    elif fault == "blur" and n % 4 == 0:  # the camera moves while the shutter is open
        rgb = cv2.blur(rgb, (33, 1))
    elif fault == "flicker" and n % 2:  # half the light
        rgb = np.rint(rgb * 0.5 ** (1 / 2.2))
    return replace(frame, rgb=np.asarray(rgb, np.uint8))


def test_a_walk_without_faults_gives_no_cause_for_complaint() -> None:
    check = PictureCheck()
    assert [check.look(frame) for frame in walk()] == [""] * len(walk())
    assert not check.counters and check.warnings == () and check.notes == [] and check.checked == len(walk())


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(fault: str) -> None:
    check = PictureCheck()
    for n in range(COUNT):
        check.look(spoiled(n, fault))
    what, most = FAULTS[fault]
    assert 1 <= check.counters[what] <= most


def test_a_warning_ends_with_its_cause_and_the_count_stays() -> None:
    check = PictureCheck()
    for frame in walk()[:BEGIN]:
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
    with pytest.raises(FrameError, match="seq=6 of camera 'rooms': pictures are too dark"):
        pipeline.step(replace(walk()[6], rgb=walk()[6].rgb // 16))
    assert pipeline.voxel_map.block_count == before and pipeline.picture_check.counters["dark"] == 1
    pipeline.step(walk()[7])
