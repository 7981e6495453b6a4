"""Depth that is computed of a whole log, for those who need single frames of it."""

from dataclasses import replace

import numpy as np

from semantic_mapper.config import DepthConfig, DepthFromMotionConfig
from semantic_mapper.replay.finetune_log import compute_depths
from semantic_mapper.types import CameraIntrinsics
from tests.drawn_room import walk_frames

CAMERA = CameraIntrinsics(220.0, 220.0, 159.5, 119.5, 320, 240)


def test_frames_of_a_log_get_depth_near_the_truth_at_their_own_size() -> None:
    frames = list(walk_frames(3, 14, CAMERA))
    dark = replace(frames[9], depth_m=None, rgb=np.zeros_like(frames[9].rgb))
    given = [replace(f, depth_m=None) for f in frames[:9]] + [dark] + [replace(f, depth_m=None) for f in frames[10:]]
    read: list[int] = []
    found = compute_depths(given, DepthConfig(from_motion=DepthFromMotionConfig(delay_frames=3)), read.append)
    assert read == list(range(1, 15))
    assert (dark.camera_id, dark.stamp_ns) not in found and len(found) == 13
    error = []
    for frame, bare in zip(frames, given, strict=True):
        if bare is dark:
            continue
        computed = found[frame.camera_id, frame.stamp_ns]
        assert computed.depth_m.shape == computed.depth_sigma_m.shape == (120, 160)
        whole = computed.on(bare)
        assert whole.depth_m is not None and whole.depth_sigma_m is not None and frame.depth_m is not None
        assert whole.depth_m.shape == (240, 320)
        np.testing.assert_allclose(whole.T_world_camera, frame.T_world_camera, atol=0.05)
        known = (whole.depth_m > 0) & (frame.depth_m > 0)
        error.append(np.median(np.abs(whole.depth_m - frame.depth_m)[known] / frame.depth_m[known]))
    assert np.median(error) < 0.1
