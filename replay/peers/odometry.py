"""Odometries that need this package: ours, and Open3D's."""

from __future__ import annotations

from typing import Any

import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.replay.peers.worker import Frame, Peer, Setup
from semantic_mapper.types import CameraIntrinsics, Float64


def ours(setup: Setup) -> Peer:
    """Ours, without closing loops: its poses as they come."""
    k = CameraIntrinsics(setup.fx, setup.fy, setup.cx, setup.cy, setup.width, setup.height)
    source = OdometryPoseSource(OdometryPoses(loop_closure=False))
    return Peer(
        lambda image: None if (found := source.pose(image)) is None else found.T_world_camera,
        prepare=lambda f: CameraImage(int(f.stamp_ns), 0, "camera", f.rgb, f.depth_m, k),
    )


def open3d(setup: Setup) -> Peer:
    """Frame to frame, point to plane, the last motion continued."""
    o3d = load_open3d()
    module, image = o3d.t.pipelines.odometry, o3d.t.geometry.Image
    K = o3d.core.Tensor(np.array([[setup.fx, 0, setup.cx], [0, setup.fy, setup.cy], [0, 0, 1]]))
    steps = [module.OdometryConvergenceCriteria(count) for count in (10, 5, 3)]
    options = 1.0, setup.depth_max_m, steps, module.Method.PointToPlane
    before: list[Any] = []
    pose = motion = np.eye(4)

    def add(frame: Frame) -> Float64:
        nonlocal pose, motion
        before.append(o3d.t.geometry.RGBDImage(image(frame.rgb), image(frame.depth_m)))
        if len(before) > 1:
            guess, last = o3d.core.Tensor(motion), before.pop(0)
            motion = module.rgbd_odometry_multi_scale(before[0], last, K, guess, *options).transformation.numpy()
            pose = pose @ motion
        return pose

    return Peer(add)
