"""The map against the reference mesh of a real recording."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import NYU40
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, PosedFrame

FRAMES = range(0, 200, 10)


def test_kitchen_surface_is_within_a_centimetre_of_its_mesh(redkitchen: Path) -> None:
    poses = np.loadtxt(redkitchen / "poses.txt").reshape(-1, 4, 4)
    intrinsics = CameraIntrinsics(526.8, 526.8, 322.4, 237.2, 640, 480)
    voxel_map = VoxelMap(VoxelMapConfig(), NYU40)
    for i in FRAMES:
        color = next((redkitchen / "color").glob(f"{i:06d}.*"))
        rgb = np.ascontiguousarray(cv2.imread(str(color))[..., ::-1])  # type: ignore[index]
        depth = cv2.imread(str(redkitchen / "depth" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
        depth_m = depth.astype(np.float32) / 1000  # type: ignore[union-attr]
        voxel_map.integrate(PosedFrame(i, i, "kinect", rgb, depth_m, None, intrinsics, poses[i]), depth_m, None, None)
    points = voxel_map.points(3.0).xyz
    mesh = np.load(redkitchen / "mesh_labels.npz")
    scene = load_open3d().t.geometry.RaycastingScene()
    tensor = load_open3d().core.Tensor
    scene.add_triangles(tensor(mesh["vertices"]), tensor(mesh["faces"].astype(np.uint32)))
    distance = scene.compute_distance(tensor(points)).numpy()
    assert np.median(distance) < 0.01
    assert (distance < 0.05).mean() > 0.85  # the mesh does not cover all that the camera sees
