from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import look_at, unproject
from semantic_mapper.mapping.allocation import blocks_in_band, make_camera
from semantic_mapper.mapping.blocks import pack_keys
from tests.mapping.rendered_views import INTRINSICS, plane_depth

POSE = look_at(np.array([0.4, -0.3, -1.1]), np.array([0.1, 0.1, 0.4]), np.array([0.1, -1.0, 0.0]))


def sampled_blocks(depth: np.ndarray, truncation: float, block: float) -> np.ndarray:
    """The same by brute force: 65 points on every pixel's ray."""
    directions = unproject(np.ones_like(depth), INTRINSICS)[depth > 0] @ POSE[:3, :3].T
    z = depth[depth > 0].astype(np.float64)
    found = [
        np.floor(((z + s)[:, None] * directions + POSE[:3, 3]) / block).astype(np.int32)
        for s in np.linspace(-truncation, truncation, 65)
    ]
    return np.unique(pack_keys(np.concatenate(found)))


@pytest.mark.parametrize("scene", ["plane", "noise"])
def test_every_block_that_a_ray_crosses_in_the_band_is_found(scene: str, rng: np.random.Generator) -> None:
    depth = plane_depth(POSE, (0.2, 0.1, 1.0), 0.45)
    if scene == "noise":
        depth = (depth + rng.uniform(-0.5, 0.5, depth.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.3] = 0
    found = blocks_in_band(depth, make_camera(INTRINSICS, POSE), 0.02, 0.08, 5.0)
    expected = sampled_blocks(depth, 0.08, 0.16)
    assert (np.diff(found) > 0).all()
    missed = np.setdiff1d(expected, found)
    # A smooth tile may pass over the tip of a block between two rays, at the end of the band.
    assert len(missed) <= (0.01 * len(expected) if scene == "plane" else 0)
    surface = sampled_blocks(depth, 0.07, 0.16)
    assert np.isin(surface, found).all(), "never within 3.5 voxels of the surface"
    assert len(found) < 1.1 * len(expected)


def test_a_frame_that_needs_more_blocks_than_its_budget_is_refused(rng: np.random.Generator) -> None:
    depth, camera = rng.uniform(0.5, 5.0, (120, 160)).astype(np.float32), make_camera(INTRINSICS, POSE)
    needed = len(blocks_in_band(depth, camera, 0.02, 0.08, 5.0))
    assert len(blocks_in_band(depth, camera, 0.02, 0.08, 5.0, needed)) == needed
    for budget in (needed - 1, 1):
        with pytest.raises(FrameError, match=f"more than {budget} blocks"):
            blocks_in_band(depth, camera, 0.02, 0.08, 5.0, budget)


@pytest.mark.parametrize("change", [{"cy": 1e19}, {"fx": 1e-3}, {"cx": 1e6}, {"fx": 1e-320}, {"cx": float("nan")}])
def test_a_camera_whose_rays_are_endless_is_refused_before_they_are_followed(change: dict[str, float]) -> None:
    camera = make_camera(INTRINSICS, POSE)._replace(**change)
    with pytest.raises(FrameError, match="check the intrinsics"):
        blocks_in_band(np.ones((120, 160), np.float32), camera, 0.02, 0.08, 5.0)
