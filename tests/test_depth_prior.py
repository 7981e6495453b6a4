"""Depth priors: holes are filled, and borders of depth lie where the image has its edges."""

import numpy as np

from semantic_mapper.imaging import depth_prior, fill_holes

NEAR_M, FAR_M, EDGE, WIDTH = 1.0, 2.0, 80, 160


def post_before_wall() -> tuple[np.ndarray, np.ndarray]:
    """Depth and image of a post, left of column ``EDGE``, before a wall; all measured, border on the edge."""
    depth_m = np.full((20, WIDTH), FAR_M, np.float32)
    depth_m[:, :EDGE] = NEAR_M
    rgb = np.full((20, WIDTH, 3), 200, np.uint8)
    rgb[:, :EDGE] = 80
    noise = np.random.default_rng(0).integers(-6, 7, rgb.shape)
    return depth_m, (rgb.astype(int) + noise).astype(np.uint8)


def test_a_near_surface_that_the_sensor_widens_ends_at_the_edge_of_the_image():
    truth, rgb = post_before_wall()
    depth_m = truth.copy()
    depth_m[:, EDGE : EDGE + 2] = NEAR_M
    np.testing.assert_allclose(depth_prior(depth_m, rgb), truth, atol=1e-6)


def test_a_hole_takes_the_surface_that_it_looks_like():
    """Not the nearest one, as most of a shadow beside a near surface would."""
    truth, rgb = post_before_wall()
    depth_m = truth.copy()
    depth_m[:, EDGE : EDGE + 3] = 0
    assert (fill_holes(depth_m) != truth).any()
    np.testing.assert_allclose(depth_prior(depth_m, rgb), truth, atol=1e-6)


def test_a_surface_at_a_grazing_angle_is_one_surface_whatever_its_texture():
    depth_m = np.tile(np.geomspace(0.5, 5.0, WIDTH, dtype=np.float32), (20, 1))
    _, rgb = post_before_wall()
    np.testing.assert_array_equal(depth_prior(depth_m, rgb), depth_m)
