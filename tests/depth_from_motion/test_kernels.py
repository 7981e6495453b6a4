"""Each kernel against the same in plain numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from semantic_mapper.depth_from_motion.agreement import TOLERANCE, find_agreement
from semantic_mapper.depth_from_motion.convolution import add_doubled, pack_convolution
from semantic_mapper.depth_from_motion.enlarge import enlarge_estimate
from semantic_mapper.depth_from_motion.evidence import describe_costs
from semantic_mapper.depth_from_motion.smooth import relax_membrane, smooth_planes
from semantic_mapper.depth_from_motion.sweep import (
    EDGE_GRAY,
    HINT_COST,
    LARGE_STEP,
    SMALL_STEP,
    UNSEEN_COST,
    inverse_depths,
    sweep_and_match,
)
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView, census_transform, prepare_view
from semantic_mapper.geometry import invert_pose
from tests.depth_from_motion.pictures import plane_frame

PLANES = inverse_depths(32, 0.8, 6.0)


def views() -> list[PreparedView]:
    return [
        prepare_view(plane_frame(x, 0.3 * x, turn=0.2 * x, seq=k)[0], 32) for k, x in enumerate((0, 0.15, 0.3, -0.2))
    ]


def plain_census(gray: np.ndarray, spacing: int) -> np.ndarray:
    padded = np.pad(gray, 2 * spacing, mode="edge")
    out = np.zeros(gray.shape, np.int32)
    height, width = gray.shape
    for j in range(5):
        for i in range(5):
            if (i, j) != (2, 2):
                other = padded[j * spacing : j * spacing + height, i * spacing : i * spacing + width]
                out = out << 1 | (other < gray)
    return out


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


def plain_path(cost: np.ndarray, gray: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """Costs (h, w, D) along the path that goes on by (dy, dx)."""
    height, width, planes = cost.shape
    out = cost.astype(int).copy()
    rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
    columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
    for y in rows:
        for x in columns:
            j, i = y - dy, x - dx
            if not (0 <= j < height and 0 <= i < width):
                continue
            large = max(LARGE_STEP / (1 + abs(int(gray[y, x]) - int(gray[j, i])) / EDGE_GRAY), 2 * SMALL_STEP)
            before = out[j, i]
            padded = np.pad(before, 1, constant_values=10**6)
            steps = np.minimum(padded[:-2], padded[2:]) + SMALL_STEP
            out[y, x] += np.minimum(np.minimum(before, steps), before.min() + int(large)) - before.min()
    assert planes == out.shape[2]
    return out


def test_census_compares_each_pixel_with_those_around_it() -> None:
    gray = np.random.default_rng(1).integers(0, 6, (13, 17)).astype(np.uint8)
    for spacing in (1, 2):
        np.testing.assert_array_equal(census_transform(gray, spacing), plain_census(gray, spacing))


def test_cost_is_the_sum_of_the_two_best_sources() -> None:
    reference, *sources = views()
    for count in (1, 3):
        swept = sweep_and_match(reference, sources[:count], PLANES, None)
        expected = plain_cost(reference, sources[:count], None)
        assert (swept.cost == expected).mean() > 0.999  # float32 puts a few points into the next pixel


def test_a_hint_costs_planes_that_are_far_from_it() -> None:
    reference, *sources = views()
    size = reference.gray.shape
    hint = DepthEstimate(np.full(size, 2.0, np.float32), np.full(size, 0.05, np.float32))
    swept = sweep_and_match(reference, sources, PLANES, hint)
    expected = plain_cost(reference, sources, hint)
    assert (np.abs(swept.cost - expected) <= 1).mean() > 0.999  # of a fraction


def test_costs_are_summed_along_eight_paths() -> None:
    reference, *sources = views()
    swept = sweep_and_match(reference, sources, PLANES, None)
    ways = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    expected = sum(plain_path(swept.cost, reference.gray, *way) for way in ways)
    np.testing.assert_array_equal(swept.path_sum, expected)


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
    np.testing.assert_array_equal(swept.match, swept.cost[rows, columns, best])


def test_neighbours_agree_where_their_depth_is_that_of_the_same_surface() -> None:
    reference, other, *_ = views()
    depth, truth = plane_frame(0, 0)[1][::2, ::2].copy(), plane_frame(0.15, 0.045, turn=0.03)[1][::2, ::2].copy()
    truth[:, :10] *= 1.2  # another surface
    estimate = DepthEstimate(truth, np.full_like(truth, 0.01))
    found = find_agreement(reference, depth, [_with_estimate(other, estimate), reference])
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


def _with_estimate(view: PreparedView, estimate: DepthEstimate) -> PreparedView:
    return replace(view, estimate=estimate)


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


def test_what_is_not_sure_takes_the_plane_around_it_and_edges_of_the_image_part_surfaces() -> None:
    x = np.arange(32, dtype=np.float32)[None].repeat(24, 0)
    truth = np.where(x < 16, 10 + 0.2 * x, 40.0).astype(np.float32)
    rgb = np.where(x < 16, 60, 200).astype(np.uint8)[..., None].repeat(3, 2)
    plane, sigma = truth.copy(), np.full_like(truth, 0.2)
    plane[6:18, 4:12], sigma[6:18, 4:12] = 55, 30
    smooth = smooth_planes(plane, sigma, rgb)
    assert np.abs(smooth - truth).max() < 0.3


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


def test_pixels_without_depth_around_them_stay_without() -> None:
    depth = np.zeros((12, 16), np.float32)
    depth[:, :4] = 1.0
    rgb, coarse = np.zeros((24, 32, 3), np.uint8), np.zeros((12, 16, 3), np.uint8)
    full = enlarge_estimate(DepthEstimate(depth, 0.1 * depth), coarse, rgb)
    assert (full.depth_m[:, :8] == 1).all() and not full.depth_m[:, 12:].any() and not full.sigma_m[:, 12:].any()


def test_the_same_bits_on_any_number_of_threads() -> None:
    reference, *sources = views()

    def all_of_it() -> bytes:
        swept = sweep_and_match(reference, sources, PLANES, None)
        depth = 1 / (PLANES[0] + swept.plane * (PLANES[1] - PLANES[0]))
        estimate = DepthEstimate(depth, 0.1 * depth)
        agreement = find_agreement(reference, depth, [_with_estimate(s, estimate) for s in sources])
        full = enlarge_estimate(estimate, reference.rgb, np.repeat(np.repeat(reference.rgb, 2, 0), 2, 1))
        return b"".join(a.tobytes() for a in (*swept, *agreement, *full))

    assert len(set(_on_threads(all_of_it))) == 1


def _on_threads(work: Callable[[], bytes]) -> list[bytes]:
    count = torch.get_num_threads()
    found: list[bytes] = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(work())
    finally:
        torch.set_num_threads(count)
    return found


@pytest.mark.parametrize(("size", "stride", "dilation"), [(1, 1, 1), (2, 2, 1), (3, 1, 1), (3, 1, 2)])
def test_convolutions_are_those_of_torch(size: int, stride: int, dilation: int) -> None:
    rng = np.random.default_rng(size)
    image = rng.standard_normal((10, 18, 7)).astype(np.float32)
    weight, bias = rng.standard_normal((20, 7, size, size)).astype(np.float32), np.arange(20, dtype=np.float32)
    found = pack_convolution(weight, bias, stride, dilation)(image)
    given = [torch.from_numpy(x) for x in (image.transpose(2, 0, 1)[None].copy(), weight, bias)]
    expected = torch.nn.functional.conv2d(*given, stride=stride, dilation=dilation)[0].numpy().transpose(1, 2, 0)
    height, width = expected.shape[:2]
    np.testing.assert_allclose(found[:height, :width], expected, atol=1e-4)


def test_doubling_is_bilinear() -> None:
    small = np.random.default_rng(0).standard_normal((5, 7, 3)).astype(np.float32)
    out = np.ones((10, 14, 3), np.float32)
    add_doubled(small, out)
    double = torch.nn.functional.interpolate(
        torch.from_numpy(small.transpose(2, 0, 1).copy())[None], scale_factor=2.0, mode="bilinear", align_corners=False
    )
    np.testing.assert_allclose(out, 1 + double[0].numpy().transpose(1, 2, 0), atol=1e-5)


def test_costs_are_described_round_the_winner() -> None:
    rng = np.random.default_rng(0)
    sums = rng.integers(0, 900, (4, 5, 32)).astype(np.uint16)
    cost = rng.integers(0, 48, (4, 5, 32)).astype(np.uint8)
    second, winner = np.empty((4, 5), np.float32), np.empty((4, 5), np.float32)
    interval, around = np.empty((4, 4, 5), np.float32), np.empty((13, 4, 5), np.float32)
    describe_costs(4, sums, cost, second, winner, interval, around)
    for y, x in np.ndindex(4, 5):
        s, c = sums[y, x].astype(int), cost[y, x].astype(int)
        best = int(s.argmin())
        others = np.where(np.abs(np.arange(32) - best) <= 1, 99999, s)
        assert second[y, x] == others.argmin() and winner[y, x] == c.argmin()
        for k, margin in enumerate((40, 160)):
            near = np.flatnonzero(s <= s[best] + margin) - best
            assert tuple(interval[2 * k : 2 * k + 2, y, x]) == (near.min(), near.max())
        at = np.clip(best + np.array((0, -6, -3, -1, 1, 3, 6)), 0, 31)
        np.testing.assert_allclose(around[:7, y, x], c[at] / 48, rtol=1e-6)
        np.testing.assert_allclose(around[7:, y, x], np.minimum((s[at[1:]] - s[best]) / 256, 2), rtol=1e-6)
