"""Rays through a snapshot against the map's own ray cast and against geometry."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.geometry import look_at
from semantic_mapper.queries.surface import cast_rays
from tests.mapping.rendered_views import INTRINSICS, ray_directions
from tests.queries.random_map import random_map
from tests.queries.scene import MIDDLE, whole, whole_map
from tests.queries.test_surface import dense

POSE = look_at(MIDDLE + np.array([0.8, 0.9, 0.7]), MIDDLE, np.array([0.0, 0.0, 1.0]))


def test_rays_meet_what_the_map_itself_shows() -> None:
    directions = ray_directions(INTRINSICS, POSE).reshape(-1, 3)  # of unit z
    hits, view = cast_rays(whole(), POSE[:3, 3], directions, 5.0), whole_map().ray_cast(POSE, INTRINSICS)
    depth = hits.distance_m / np.linalg.norm(directions, axis=1)
    hit = (depth > 0) & (view.depth_m.ravel() > 0)
    assert hit.mean() > 0.6 and ((depth > 0) == (view.depth_m.ravel() > 0)).mean() > 0.99
    assert np.quantile(np.abs(depth - view.depth_m.ravel())[hit], 0.98) < 0.001
    assert (hits.label == view.label.ravel())[hit].mean() > 0.97  # the map interpolates evidence
    assert not hits.label[depth == 0].any() and not hits.confidence[hits.label == 0].any()
    close = np.abs(hits.rgb.astype(int) - view.rgb.reshape(-1, 3)).max(axis=1) <= 16
    assert close[hit].mean() > 0.9


@pytest.mark.parametrize("seed", range(3))
def test_hits_in_random_blocks_lie_on_a_zero_of_the_interpolated_field(seed: int) -> None:
    snapshot = random_map(seed)
    tsdf, observed, first = dense(snapshot)

    def field(p: np.ndarray) -> float:
        """TSDF at a point (voxel units), interpolated over the observed voxels."""
        low, total, fractions = np.floor(p).astype(int), 0.0, 0.0
        for corner in np.ndindex(2, 2, 2):
            at = low + corner
            if observed[tuple(at - first)]:
                fraction = float(np.prod(1 - np.abs(p - at)))
                total, fractions = total + fraction * tsdf[tuple(at - first)] / 127, fractions + fraction
        return total / fractions

    rng = np.random.default_rng(seed)
    origins, directions = rng.uniform(-0.3, 0.3, (300, 3)), rng.normal(size=(300, 3))
    directions[::10] = np.eye(3)[rng.integers(0, 3, 30)]  # along blocks and voxels
    origins[::20] = np.round(origins[::20] / 0.02) * 0.02
    hits = cast_rays(snapshot, origins, directions)
    met = np.flatnonzero(hits.distance_m)
    assert len(met) > 30
    places = origins + hits.distance_m[:, None] * directions / np.linalg.norm(directions, axis=1)[:, None]
    off = np.array([abs(field(places[n] / 0.02)) for n in met])
    assert np.median(off) < 2e-3 and np.quantile(off, 0.9) < 0.1  # a root may not be reached where noise is strong
