"""Rooms as streams: frames as a log would give them, with the truth beside them for evaluation."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from research.scenes import (
    TRAIN_SEEDS,
    CameraPathConfig,
    NoiseConfig,
    PoseNoiseConfig,
    RoomConfig,
    camera_path,
    make_room,
    room_frames,
    room_views,
)
from research.scenes.survey import class_shares, contact_sheet, images_per_second
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(fx=66.0, fy=66.0, cx=47.5, cy=35.5, width=96, height=72)
FAST = RoomConfig(shadow_resolution=16)
SHELL = [ROOMS.ids[ROOMS.names.index(name)] for name in ("wall", "floor", "ceiling")]


def test_room_frames_are_a_stream_of_posed_frames() -> None:
    frames = list(room_frames(11, 5, CAMERA, noise=NoiseConfig()))
    assert [f.seq for f in frames] == [0, 1, 2, 3, 4]
    assert (np.diff([f.stamp_ns for f in frames]) > 0).all()
    for frame in frames:
        assert frame.depth_m is not None
        assert frame.label is not None
        assert set(np.unique(frame.label)) <= {*ROOMS.ids, ROOMS.ignore_id}
    again = list(room_frames(11, 5, CAMERA, noise=NoiseConfig()))
    np.testing.assert_array_equal(frames[3].rgb, again[3].rgb)


def test_views_carry_noisy_depth_to_the_robot_and_exact_depth_to_the_judge() -> None:
    noisy = list(room_views(11, 2, CAMERA, room=FAST, noise=NoiseConfig(depth="oak_d")))
    clean = list(room_views(11, 2, CAMERA, room=FAST))
    for with_noise, without in zip(noisy, clean, strict=True):
        np.testing.assert_array_equal(with_noise.rendered.exact_depth_m, without.frame.depth_m)
        assert with_noise.frame.depth_m is with_noise.rendered.depth_m
        assert (with_noise.rendered.depth_m != with_noise.rendered.exact_depth_m).mean() > 0.9
        np.testing.assert_array_equal(with_noise.rendered.instance, without.rendered.instance)


def test_a_camera_without_depth_sensor_gives_frames_without_depth() -> None:
    view = next(room_views(11, 1, CAMERA, room=FAST, noise=NoiseConfig(depth="none")))
    assert view.frame.depth_m is None
    assert (view.rendered.exact_depth_m > 0).all()


def test_drifting_poses_reach_the_frames_while_the_truth_stays_beside_them() -> None:
    views = list(room_views(11, 8, CAMERA, room=FAST, pose_noise=PoseNoiseConfig(translation_share=0.05)))
    exact = camera_path(make_room(11, FAST), 8, 11)
    np.testing.assert_array_equal([v.T_world_camera for v in views], exact)
    assert np.abs(views[-1].frame.T_world_camera - exact[-1]).max() > 1e-4


def test_noise_changes_colours_but_no_label() -> None:
    noisy, clean = (next(room_views(5, 1, CAMERA, room=FAST, noise=n)) for n in (NoiseConfig(), None))
    np.testing.assert_array_equal(noisy.rendered.label, clean.rendered.label)
    assert (noisy.frame.rgb != clean.frame.rgb).mean() > 0.5


def test_hardly_any_frame_shows_nothing_but_walls() -> None:
    path = CameraPathConfig(step_m=0.3)
    bare = [
        np.isin(frame.label, SHELL).mean() > 0.97
        for seed in TRAIN_SEEDS[:10]
        for frame in room_frames(seed, 8, CAMERA, room=FAST, path=path)
    ]
    assert np.mean(bare) < 0.03


def test_the_survey_draws_counts_and_measures() -> None:
    sheet = contact_sheet(TRAIN_SEEDS[:3], 1, across=2, camera=CAMERA)
    assert sheet.shape == (2 * 72, 2 * 3 * 96, 3)
    assert sheet.std() > 20
    shares = class_shares(TRAIN_SEEDS[:3], 2)
    assert sum(fraction[0] for fraction in shares.values()) == pytest.approx(1.0)
    assert all(0 <= fraction[1] <= 1 for fraction in shares.values())
    figures = images_per_second(islice(TRAIN_SEEDS, 1), 1, "oak_d")
    assert figures["views_per_s"] > 0
