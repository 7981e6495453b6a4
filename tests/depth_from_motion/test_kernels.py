"""Each kernel against the same in plain numpy."""

from dataclasses import replace

import numpy as np

from semantic_mapper.depth_from_motion.estimate import TOLERANCE, find_agreement, relax_membrane
from semantic_mapper.depth_from_motion.sweep import HINT_COST, UNSEEN_COST, inverse_depths, sweep_and_match
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView, enlarge_estimate, prepare_view
from semantic_mapper.geometry import invert_pose
from tests.depth_from_motion.pictures import plane_frame

PLANES = inverse_depths(32, 0.8, 6.0)


def views() -> list[PreparedView]:
    return [
        prepare_view(plane_frame(x, 0.3 * x, turn=0.2 * x, seq=k)[0], 32) for k, x in enumerate((0, 0.15, 0.3, -0.2))
    ]


def plain_cost(reference: PreparedView, sources: list[PreparedView], hint: DepthEstimate | None) -> np.ndarray:
    """Matching cost (h, w, D), point by point in float64."""
    k = reference.intrinsics
    v, u = np.mgrid[: k.height, : k.width]
    rays = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)), -1)
    points = rays[:, :, None] / PLANES[:, None].astype(np.float64)  # h w D 3
    bits = reference.census[::2, ::2][..., None]
    found, seen = [], []
    for source in sources:
        T = invert_pose(source.T_world_camera) @ reference.T_world_camera
        p = points @ T[:3, :3].T + T[:3, 3]
        d = source.intrinsics_double
        x, y = d.fx * p[..., 0] / p[..., 2] + d.cx, d.fy * p[..., 1] / p[..., 2] + d.cy
        inside = (p[..., 2] > 0.05) & (x >= 0) & (y >= 0) & (x < d.width) & (y < d.height)
        other = source.census[np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int)]
        found.append(np.where(inside, np.bitwise_count(other ^ bits), 64).astype(int))
        seen.append(inside)
    lowest = np.sort(found, axis=0)
    count = np.sum(seen, axis=0)
    cost = np.where(count == 1, 2 * lowest[0], UNSEEN_COST)
    if len(sources) > 1:
        cost = np.where(count > 1, lowest[0] + lowest[1], cost)
    if hint is not None:
        step = PLANES[1] - PLANES[0]
        plane = (1 / hint.depth_m - PLANES[0]) / step
        rate = 1 / (3 * hint.sigma_m / hint.depth_m**2 / step + 2)
        off = (np.arange(len(PLANES)) - plane[..., None]) * rate[..., None]
        cost = cost + (HINT_COST * np.minimum(off**2, 1)).astype(int)
    return cost


def test_cost_is_the_sum_of_the_two_best_sources_and_of_the_distance_from_a_hint() -> None:
    reference, *sources = views()
    size = reference.gray.shape
    hint = DepthEstimate(np.full(size, 2.0, np.float32), np.full(size, 0.05, np.float32))
    for count, given in ((1, None), (3, None), (3, hint)):
        swept = sweep_and_match(reference, sources[:count], PLANES, given)
        expected = plain_cost(reference, sources[:count], given)
        # float32 puts a few points into the next pixel; a hint's cost is a fraction
        assert (np.abs(swept.cost.astype(int) - expected) <= (given is not None)).mean() > 0.999


def test_the_best_plane_lies_at_the_bottom_of_a_parabola() -> None:
    reference, *sources = views()
    swept = sweep_and_match(reference, sources, PLANES, None)
    total = swept.path_sum.astype(float)
    best = total.argmin(2)
    rows, columns = np.indices(best.shape)
    inner = (best > 0) & (best < len(PLANES) - 1)
    left, middle, right = (total[rows, columns, np.clip(best + o, 0, len(PLANES) - 1)] for o in (-1, 0, 1))
    bend = np.where(left - 2 * middle + right > 0, left - 2 * middle + right, 1)
    offset = np.where(inner & (left - 2 * middle + right > 0), 0.5 * (left - right) / bend, 0)
    np.testing.assert_allclose(swept.plane, best + offset, atol=1e-5)
    far = np.abs(np.arange(len(PLANES)) - best[..., None]) > 1
    rival = np.where(far, total, np.inf).min(2)
    np.testing.assert_allclose(swept.confidence, (rival - middle) / rival, atol=1e-6)


def test_neighbours_agree_where_their_depth_is_that_of_the_same_surface() -> None:
    reference, other, *_ = views()
    depth, truth = plane_frame(0, 0)[1][::2, ::2].copy(), plane_frame(0.15, 0.045, turn=0.03)[1][::2, ::2].copy()
    truth[:, :10] *= 1.2  # another surface
    estimate = DepthEstimate(truth, np.full_like(truth, 0.01))
    found = find_agreement(reference, depth, [replace(other, estimate=estimate), reference])
    k, T = reference.intrinsics, invert_pose(other.T_world_camera) @ reference.T_world_camera
    v, u = np.indices(depth.shape)
    p = (
        np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)), -1) * depth[..., None] @ T[:3, :3].T
        + T[:3, 3]
    )
    x, y = np.floor(k.fx * p[..., 0] / p[..., 2] + k.cx + 0.5), np.floor(k.fy * p[..., 1] / p[..., 2] + k.cy + 0.5)
    inside = (x >= 0) & (y >= 0) & (x < k.width) & (y < k.height)
    seen = np.where(inside, truth[np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int)], 0)
    agree = inside & (np.abs(seen - p[..., 2]) < TOLERANCE * p[..., 2])
    np.testing.assert_array_equal(found.visible, inside)
    np.testing.assert_array_equal(found.agree, agree)
    assert 0.3 < agree.mean() < 0.95
    mean = np.where(agree, 2 / (1 / depth + p[..., 2] / np.where(agree, seen, 1) / depth), depth)
    np.testing.assert_allclose(found.mean_m, mean, rtol=1e-5)


def test_a_membrane_is_the_least_squares_surface() -> None:
    rng = np.random.default_rng(2)
    data, weight, right, below = (rng.uniform(0.1, 2, (7, 9)).astype(np.float32) for _ in range(4))
    out = np.zeros_like(data)
    relax_membrane(data, weight, right, below, out, 300, 1.5)
    number = np.arange(data.size).reshape(data.shape)
    left = np.diag(weight.ravel().astype(float))
    for tie, one, other in ((right[:, :-1], number[:, :-1], number[:, 1:]), (below[:-1], number[:-1], number[1:])):
        for t, a, b in zip(tie.ravel(), one.ravel(), other.ravel(), strict=True):
            left[[a, b], [a, b]] += t
            left[[a, b], [b, a]] -= t
    expected = np.linalg.solve(left, (weight * data).ravel())
    np.testing.assert_allclose(out.ravel(), expected, atol=1e-5)


def test_an_enlarged_plane_is_a_plane() -> None:
    frame, depth = plane_frame()
    view = prepare_view(frame, 32)
    k = view.intrinsics
    v, u = np.indices((k.height, k.width))
    coarse = 2.0 / (0.25 * (u - k.cx) / k.fx + 0.1 * (v - k.cy) / k.fy + 1)
    estimate = DepthEstimate(coarse.astype(np.float32), np.full(coarse.shape, 0.02, np.float32))
    full = enlarge_estimate(estimate, view.rgb, frame.rgb)
    np.testing.assert_allclose(full.depth_m[1:-1, 1:-1], depth[1:-1, 1:-1], rtol=1e-5)
    np.testing.assert_allclose(full.sigma_m, 0.02, rtol=1e-5)


def test_no_enlarged_depth_lies_between_two_surfaces_and_borders_lie_on_edges() -> None:
    depth = np.full((12, 16), 3.0, np.float32)
    depth[:, :8] = 1.0
    rgb = np.full((48, 64, 3), 200, np.uint8)
    rgb[:, :34] = 60  # the edge of the image lies two pixels right of that of the depth
    coarse = np.full((12, 16, 3), 200, np.uint8)
    coarse[:, :8] = 60
    full = enlarge_estimate(DepthEstimate(depth, 0.1 * depth), coarse, rgb)
    np.testing.assert_allclose(full.depth_m, np.where(np.arange(64) < 34, 1.0, 3.0)[None].repeat(48, 0), rtol=1e-6)
    np.testing.assert_allclose(full.sigma_m, 0.1 * full.depth_m, rtol=1e-5)
    depth[:, 4:] = 0
    full = enlarge_estimate(DepthEstimate(depth, 0.1 * depth), coarse, rgb)
    assert (full.depth_m[:, :16] == 1).all() and not full.depth_m[:, 24:].any() and not full.sigma_m[:, 24:].any()
