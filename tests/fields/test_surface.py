"""Surface maps against planes whose answer is known, and against rooms whose gravity is."""

import math

import numpy as np
import pytest
import torch

from research.scenes import TRAIN_SEEDS, NoiseConfig, room_views
from semantic_mapper.fields.surface import surface_maps, surface_normals, up_direction
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(110.0, 110.0, 79.5, 59.5, 160, 120)
K = torch.from_numpy(camera_matrix(CAMERA)).float()[None]
HEIGHT_M = 1.4


def looking_down(pitch: float) -> torch.Tensor:
    """Up (3,) in the axes of a camera that is inclined downwards."""
    return torch.tensor([0.0, -math.cos(pitch), -math.sin(pitch)])


def floor_depth(pitch: float) -> torch.Tensor:
    """Depth (1, H, W) of a level floor below the camera; 0 where the ray does not fall."""
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    ray = torch.stack(((u - 79.5) / 110, (v - 59.5) / 110, torch.ones_like(u)))
    falls = -torch.einsum("ihw,i->hw", ray, looking_down(pitch))
    depth = torch.where(falls > 0.05, HEIGHT_M / falls.clamp_min(0.05), 0)
    return depth[None]


@pytest.mark.parametrize("pitch_deg", [0, 15, 40])
def test_a_level_floor_is_level_at_height_nought_and_faces_up(pitch_deg: int):
    depth = floor_depth(math.radians(pitch_deg))
    inverse, measured, height, level, facing = surface_maps(depth, K)[0]
    seen = depth[0] > 0
    assert torch.equal(measured, seen.float())
    torch.testing.assert_close(inverse[seen], 1 / depth[0][seen])
    assert float(height[seen].abs().max()) < 0.02
    inner = level != 0  # beside holes and at the border there is no normal
    assert inner.float().mean() > 0.3
    assert float(level[inner].min()) > 0.999
    torch.testing.assert_close(
        facing[inner], torch.full_like(facing[inner], -math.sin(math.radians(pitch_deg))), atol=2e-2, rtol=0
    )


def test_a_wall_is_plumb_and_its_height_counts_from_the_lowest_point():
    depth = torch.full((1, 120, 160), 2.0)
    _, _, height, level, facing = surface_maps(depth, K)[0]
    assert float(level.abs().max()) < 1e-3
    torch.testing.assert_close(facing[10:-10, 10:-10], torch.full((100, 140), -1.0))
    assert float(height[0, 0] - height[-1, 0]) == pytest.approx(2.0 * 119 / 110, abs=1e-3)
    assert -0.1 < float(height[-1, 80]) < 0.0 or float(height[-1, 80]) == pytest.approx(0, abs=0.1)


def test_without_depth_there_is_nothing_and_holes_stay_holes():
    assert not surface_maps(torch.zeros(2, 24, 32), K.expand(2, 3, 3)).any()
    depth = floor_depth(0.5)
    depth[0, 70:80, 60:90] = 0
    maps = surface_maps(torch.cat((depth, torch.zeros_like(depth))), K.expand(2, 3, 3))
    assert not maps[0, :, 70:80, 60:90].any()
    assert not maps[1].any()
    assert torch.isfinite(maps).all()


def test_an_image_too_small_for_normals_has_none():
    points = torch.rand(1, 3, 4, 4)
    normal, known = surface_normals(points, torch.ones(1, 4, 4, dtype=torch.bool), 2)
    assert not known.any() and not normal.any()


def test_up_without_any_normal_is_the_cameras_own():
    up = up_direction(torch.zeros(1, 3, 8, 8), torch.zeros(1, 8, 8, dtype=torch.bool))
    torch.testing.assert_close(up[0].abs(), torch.tensor([0.0, 1.0, 0.0]))
    assert float(up[0, 1]) < 0


def test_gravity_is_found_in_noisy_images_of_rooms():
    errors = []
    for seed in TRAIN_SEEDS[:6]:
        for view in room_views(seed, 4, CAMERA, noise=NoiseConfig()):
            assert view.frame.depth_m is not None
            depth = torch.from_numpy(view.frame.depth_m).float()[None]
            v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
            points = torch.stack(((u - 79.5) / 110, (v - 59.5) / 110, torch.ones_like(u)))[None] * depth
            normal, known = surface_normals(points, depth > 0, 2)
            up = up_direction(normal[..., ::4, ::4], known[:, ::4, ::4])[0].numpy()
            true = view.T_world_camera[:3, :3].T @ np.array([0.0, 0.0, 1.0])
            errors.append(np.degrees(np.arccos(np.clip(up @ true, -1, 1))))
    assert np.median(errors) < 2 and np.quantile(errors, 0.9) < 6, np.round(np.sort(errors), 1)
