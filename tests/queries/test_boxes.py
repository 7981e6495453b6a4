"""Points and mesh in a box are those of the whole map that lie in it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from semantic_mapper.queries.boxes import mesh_in_box, points_in_box
from tests.queries.scene import LABELS, surface_of, whole, whole_map

LOWER, UPPER = (-0.3137, -0.2711, 0.0513), (0.8329, 0.3317, 0.3719)


def test_points_are_all_surface_points_in_the_box() -> None:
    xyz, label, confidence = surface_of(whole())
    inside = ((xyz >= LOWER) & (xyz <= UPPER)).all(axis=1)
    found = points_in_box(whole(), LOWER, UPPER)
    assert 500 < inside.sum() < 0.8 * len(xyz)
    np.testing.assert_allclose(found.xyz, xyz[inside], atol=1e-6)
    np.testing.assert_array_equal(found.label, label[inside])
    np.testing.assert_allclose(found.confidence, confidence[inside] / 255, atol=1e-6)
    assert found.xyz.dtype == found.confidence.dtype == np.float32 and found.rgb.shape == found.xyz.shape


def test_mesh_is_the_maps_own_where_it_lies_in_the_box() -> None:
    mine, theirs = mesh_in_box(whole(), LOWER, UPPER), whole_map().mesh()
    center = theirs.vertices[theirs.faces].mean(axis=1)
    inside = ((center > LOWER) & (center < UPPER)).all(axis=1)
    assert abs(len(mine.faces) - inside.sum()) < 0.02 * inside.sum() and inside.sum() > 1000
    assert mine.faces.max() == len(mine.vertices) - 1 and len(np.unique(mine.faces)) == len(mine.vertices)
    mine_center = mine.vertices[mine.faces].mean(axis=1)
    assert ((mine_center >= LOWER) & (mine_center <= UPPER)).all()
    distance, nearest = KDTree(theirs.vertices).query(mine.vertices)
    assert np.quantile(distance, 0.99) < 0.001
    assert (mine.label == theirs.label[nearest]).mean() > 0.95 and set(mine.label) <= {0, *LABELS.ids}
    assert (np.abs(mine.confidence - theirs.confidence[nearest]) < 0.1).mean() > 0.9


def test_a_box_in_the_air_holds_nothing() -> None:
    assert len(points_in_box(whole(), (5, 5, 5), (6, 6, 6)).xyz) == 0
    mesh = mesh_in_box(whole(), (5, 5, 5), (6, 6, 6))
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3) and len(mesh.label) == 0
