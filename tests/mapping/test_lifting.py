import numpy as np

from semantic_mapper.mapping.lifting import lift


def test_lifted_classes_follow_the_image_edge_not_the_coarse_grid():
    rgb = np.zeros((32, 32, 3), np.uint8)
    rgb[:, 13:] = 200  # the edge lies within a coarse pixel of 4
    depth = np.full((32, 32), 2.0, np.float32)
    low_rgb = rgb[2::4, 2::4].copy()
    probabilities = np.zeros((8, 8, 2), np.float32)
    probabilities[..., 0] = low_rgb[..., 0] == 0
    probabilities[..., 1] = low_rgb[..., 0] > 0
    full, known = lift(probabilities, np.ones((8, 8), bool), low_rgb, depth[2::4, 2::4].copy(), rgb, depth)
    assert known.all()
    assert (full.argmax(2) == (rgb[..., 0] > 0)).all()


def test_lifted_classes_follow_a_depth_edge_between_equal_colours():
    rgb = np.full((32, 32, 3), 90, np.uint8)
    depth = np.full((32, 32), 2.0, np.float32)
    depth[:, 18:] = 3.0
    low_depth = depth[2::4, 2::4].copy()
    probabilities = np.stack((low_depth < 2.5, low_depth > 2.5), -1).astype(np.float32)
    full, _ = lift(probabilities, np.ones((8, 8), bool), rgb[2::4, 2::4].copy(), low_depth, rgb, depth)
    assert (full.argmax(2) == (depth > 2.5)).all()


def test_lifted_probabilities_sum_to_one():
    rng = np.random.default_rng(0)
    p = rng.random((6, 8, 5)).astype(np.float32)
    p /= p.sum(2, keepdims=True)
    rgb = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    depth = rng.random((24, 32)).astype(np.float32) + 1
    full, _ = lift(p, np.ones((6, 8), bool), rgb[2::4, 2::4].copy(), depth[2::4, 2::4].copy(), rgb, depth)
    np.testing.assert_allclose(full.sum(2), 1, atol=1e-5)


def test_pixels_without_a_known_neighbour_stay_unknown():
    known = np.zeros((8, 8), bool)
    known[0, 0] = True
    p = np.full((8, 8, 2), 0.5, np.float32)
    rgb, depth = np.zeros((32, 32, 3), np.uint8), np.ones((32, 32), np.float32)
    full, full_known = lift(p, known, rgb[::4, ::4].copy(), depth[::4, ::4].copy(), rgb, depth)
    assert full_known[0, 0] and not full_known[20:, 20:].any()
    assert full[20:, 20:].max() == 0
