"""Votes and fusion kernels, held against plain numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.geometry import look_at
from semantic_mapper.mapping.allocation import make_camera
from semantic_mapper.mapping.block_grid import GridBuffers
from semantic_mapper.mapping.clearing import Scene
from semantic_mapper.mapping.fusion import (
    COMPUTED_CAP,
    COMPUTED_LOOK,
    EVIDENCE_STEPS,
    MEASURED,
    PROBABILITY_FLOOR,
    Votes,
    fuse_blocks,
    make_limits,
    make_votes,
    vote_into_blocks,
)
from semantic_mapper.types import Float32
from tests.mapping.grids import random_grid
from tests.mapping.rendered_views import INTRINSICS

POSE = look_at(np.array([0.02, -0.03, -0.5]), np.array([0.03, 0.01, 0.1]), np.array([0.1, -1.0, 0.0]))
CAMERA = make_camera(INTRINSICS, POSE)
LIMITS = make_limits(VoxelMapConfig())._replace(max_weight=5.0)
SIZE = (120, 160)


def some_depth(rng: np.random.Generator) -> Float32:
    """Around the middle of a random grid, with holes and what is no depth."""
    depth = (0.5 + rng.normal(0, 0.02, SIZE)).astype(np.float32)
    for value in (0, np.nan, np.inf, -1, 99):
        depth[rng.random(SIZE) < 0.03] = value
    return depth


def some_votes(rng: np.random.Generator, depth: Float32) -> Votes:
    rows = rng.integers(-1, 50, SIZE).astype(np.int32)
    return make_votes(rng.dirichlet(np.full(4, 0.4), 50).astype(np.float32), rows, depth, CAMERA, 5.0)[0]


def test_votes_weigh_what_plain_numpy_says(rng: np.random.Generator) -> None:
    depth, p = some_depth(rng), rng.dirichlet(np.full(4, 0.4), 50).astype(np.float32)
    p[3, 1], p[7, 2] = np.nan, -0.2
    p[9] *= 1.5
    rows = rng.integers(-1, 50, SIZE).astype(np.int32)
    votes, bad = make_votes(p, rows, depth, CAMERA, 5.0)
    proper = np.ones(50, bool)
    proper[[3, 7, 9]] = False
    log_p = np.log(np.maximum(p[proper], PROBABILITY_FLOOR))
    np.testing.assert_allclose(votes.evidence[proper], -EVIDENCE_STEPS * log_p, atol=0.51)
    z = depth.astype(np.float64)
    v, u = np.indices(SIZE)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = (z > 0) & (z <= 5.0)
        dz_dv, dz_du = np.gradient(z)
        nx, ny = CAMERA.fx * dz_du, CAMERA.fy * dz_dv
        normal = np.stack((nx, ny, -(z + x * nx + y * ny)), -1)
        ray = np.stack((x, y, np.ones(SIZE)), -1)
        cosine = np.abs((normal * ray).sum(-1)) / np.linalg.norm(normal, axis=-1) / np.linalg.norm(ray, axis=-1)
        near = np.minimum((2.0 / z) ** 2, 1)
    known = np.zeros(SIZE, bool)
    known[1:-1, 1:-1] = (z[:-2, 1:-1] > 0) & (z[2:, 1:-1] > 0) & (z[1:-1, :-2] > 0) & (z[1:-1, 2:] > 0)
    due = measured & (rows >= 0)
    assert bad == (due & ~proper[rows]).sum() > 100
    expected = np.where(due & proper[rows], np.where(known & (cosine > 0.2), cosine, 0.2) * near, 0)
    assert 1000 < (expected > 0.2).sum() < due.sum()
    np.testing.assert_allclose(votes.weights, expected, rtol=1e-4, atol=1e-6)


class Seen(NamedTuple):
    """Voxels (N,) that a frame says something of: block and voxel, pixel, distance in front of the surface."""

    at: tuple[np.ndarray, np.ndarray]
    pixel: tuple[np.ndarray, np.ndarray]
    distance: Float32


def seen_voxels(keys: np.ndarray, depth: Float32, behind: float) -> Seen:
    """In float64; pixel borders are nowhere near enough for float32 to decide otherwise (checked)."""
    z, y, x = np.unravel_index(np.arange(512), (8, 8, 8))
    p = ((keys[:, None] * 8 + np.stack((x, y, z), 1)) * LIMITS.voxel_size - CAMERA.t) @ CAMERA.R
    u = CAMERA.fx * p[..., 0] / p[..., 2] + CAMERA.cx + 0.5
    v = CAMERA.fy * p[..., 1] / p[..., 2] + CAMERA.cy + 0.5
    inside = (p[..., 2] > 0) & (u >= 0) & (v >= 0) & (u < SIZE[1]) & (v < SIZE[0])
    column, row = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    d = depth[row, column]
    with np.errstate(invalid="ignore"):
        distance = d - p[..., 2]
        seen = inside & (d > 0) & (d <= LIMITS.depth_max) & (distance >= -behind)
    at = np.nonzero(seen)
    border = min(np.abs(a - np.round(a))[seen].min() for a in (u, v))
    assert border > 1e-5 and np.nanmin(np.abs(distance[inside] + behind)) > 1e-7
    return Seen((at[0], at[1]), (row[seen], column[seen]), distance[seen].astype(np.float32))


def vote(expected: np.ndarray, votes: np.ndarray, seen: Seen, given: Votes, chosen: np.ndarray) -> None:
    """Add votes to means of what votes say, with the cap."""
    at, pixel = tuple(a[chosen] for a in seen.at), tuple(a[chosen] for a in seen.pixel)
    weight = given.weights[pixel].astype(np.float64)
    votes[at] = np.minimum(votes[at].astype(np.float64) + weight, LIMITS.max_weight)
    expected[at] += (weight / votes[at])[:, None] * (given.evidence[given.rows[pixel]] - expected[at])


def copy(buffers: GridBuffers) -> GridBuffers:
    return GridBuffers(*(values.copy() for values in buffers))


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("measured", [False, True])
def test_a_fused_frame_is_that_of_plain_numpy(trusted: bool, measured: bool, rng: np.random.Generator) -> None:
    _, buffers = random_grid(rng)
    buffers.weight[:] = np.minimum(buffers.weight, 5)
    few = rng.random(buffers.weight.shape) < 0.5  # looks of computed depth, up to their cap
    buffers.weight[few & (buffers.weight > 0)] = (
        rng.integers(1, 32, buffers.weight.shape)[few & (buffers.weight > 0)] / 32
    )
    before, blocks = copy(buffers), np.array([7, 0, 3, 4, 8], np.int32)
    depth, rgb = some_depth(rng), rng.integers(0, 256, (*SIZE, 3), np.uint8)
    votes = some_votes(rng, depth)
    trust = rng.uniform(0.1, 1, SIZE).astype(np.float32) if trusted else np.empty((0, 0), np.float32)
    fuse_blocks(blocks, buffers, Scene(CAMERA, LIMITS, depth, rgb), trust, votes, measured=measured)
    expected, means = copy(before), before.evidence.astype(np.float64)
    seen = seen_voxels(before.keys[blocks], depth, LIMITS.truncation)
    seen = seen._replace(at=(blocks[seen.at[0]], seen.at[1]))
    assert len(seen.distance) > 500
    look, cap = (MEASURED, LIMITS.max_weight) if measured else (COMPUTED_LOOK, COMPUTED_CAP)
    free = np.ones(len(seen.distance), np.bool_) if measured else before.weight[seen.at] < MEASURED
    assert free.sum() > 200 and (measured or (~free).sum() > 200)
    at, pixel = tuple(a[free] for a in seen.at), tuple(a[free] for a in seen.pixel)
    old, new = before.weight[at], np.float32(look) * (trust[pixel] if trusted else np.float32(1))
    signed = np.minimum(seen.distance[free] / LIMITS.truncation, 1)
    expected.tsdf[at] = (old * before.tsdf[at] + new * signed) / (old + new)
    mixed = old[:, None] * before.color[at] + np.reshape(new, (-1, 1)) * rgb[pixel]
    expected.color[at] = mixed / np.reshape(old + new, (-1, 1))
    expected.weight[at] = np.minimum(old + new, cap)
    assert (expected.weight[at] == cap).any()
    chosen = (votes.weights[seen.pixel] > 0) & (np.abs(seen.distance) <= LIMITS.vote_band)
    assert chosen.sum() > 200
    vote(means, expected.votes, seen, votes, chosen)
    for name in ("tsdf", "weight", "color", "votes"):
        np.testing.assert_allclose(getattr(buffers, name), getattr(expected, name), rtol=2e-5, atol=2e-5, err_msg=name)
    kept = np.ones(before.weight.shape, np.bool_)
    kept[at] = False
    for name in ("tsdf", "weight", "color"):
        assert getattr(buffers, name)[kept].tobytes() == getattr(before, name)[kept].tobytes(), name
    np.testing.assert_allclose(buffers.evidence, means, atol=0.51)


def test_votes_alone_go_to_measured_voxels_with_few_votes(rng: np.random.Generator) -> None:
    _, buffers = random_grid(rng)
    before, blocks, depth = copy(buffers), np.arange(9, dtype=np.int32), some_depth(rng)
    votes, few = some_votes(rng, depth), 2.0
    vote_into_blocks(9, blocks, buffers, CAMERA, LIMITS, depth, votes, few)
    means, total = before.evidence.astype(np.float64), before.votes.copy()
    seen = seen_voxels(before.keys, depth, LIMITS.vote_band)
    chosen = (votes.weights[seen.pixel] > 0) & (np.abs(seen.distance) <= LIMITS.vote_band)
    chosen &= (before.weight[seen.at] > 0) & (before.votes[seen.at] < few)
    assert chosen.sum() > 100
    vote(means, total, seen, votes, chosen)
    np.testing.assert_allclose(buffers.votes, total, rtol=1e-5)
    np.testing.assert_allclose(buffers.evidence, means, atol=0.51)
    for name in ("tsdf", "weight", "color"):
        assert getattr(buffers, name).tobytes() == getattr(before, name).tobytes()
