"""Point queries against a search of all surface points, and against the known scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semantic_mapper.errors import LabelError, MapError
from semantic_mapper.queries.nearest import at, nearest
from semantic_mapper.queries.occupancy import State, occupancy
from tests.queries.scene import BALL, BOX, CUP, FLOOR, LABELS, RADIUS, TABLE, surface_of, whole

COORDINATE = st.floats(-1.5, 1.5)
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


@pytest.mark.parametrize("radius", [None, 0.02, 0.11])
def test_the_class_is_that_of_the_nearest_surface_point(radius: float | None) -> None:
    xyz, label, confidence = surface_of(whole())
    rng = np.random.default_rng(1)
    points = np.concatenate((xyz[::40] + rng.normal(0, 0.02, xyz[::40].shape), rng.uniform(-1, 1, (200, 3))))
    found = at(whole(), points, radius)
    distance = np.linalg.norm(points[:, None] - xyz, axis=2)
    least = distance.min(axis=1)
    near = least <= (0.05 if radius is None else radius)
    assert near.sum() > 20 and (~near).sum() > 50
    np.testing.assert_allclose(found.distance_m[near], least[near], atol=1e-6)
    assert np.isinf(found.distance_m[~near]).all()
    assert not found.label[~near].any() and not found.confidence[~near].any()
    second = np.partition(distance, 1, axis=1)[:, 1]
    clear = near & (second > least + 1e-9)  # of two equally near, either will do
    nearest_one = distance.argmin(axis=1)
    np.testing.assert_array_equal(found.label[clear], label[nearest_one][clear])
    np.testing.assert_allclose(found.confidence[clear], confidence[nearest_one][clear] / 255, atol=1e-6)


def test_known_places_of_the_scene() -> None:
    up = np.array([0.0, 0.0, 1.0])
    top, summit, floor = BOX + 0.2 * up, BALL + RADIUS * up, np.array([0.3, 0.5, 0.0])
    found = at(whole(), np.stack((top, summit, floor, top + 0.05 * up, summit + 0.05 * up, top + 5 * up)))
    assert found.label.tolist() == [TABLE, CUP, FLOOR, 0, 0, 0]
    assert found.state.tolist()[3:] == [State.FREE, State.FREE, State.UNKNOWN]
    assert (found.confidence[:3] > 0.5).all()
    inside = np.stack((top, summit, floor)) - 0.03 * up
    assert occupancy(whole(), inside).tolist() == [State.OCCUPIED] * 3
    deep = np.stack((BOX, floor - 0.4 * up))
    assert occupancy(whole(), deep).tolist() == [State.UNKNOWN] * 2, "nobody has looked there"


@settings(max_examples=60, deadline=None)
@given(point=POINT, name=st.sampled_from(["floor", "table", "cup"]), quantile=st.sampled_from([None, 0.5, 0.9]))
def test_nearest_is_the_nearest_of_all(point: tuple[float, float, float], name: str, quantile: float | None) -> None:
    xyz, label, confidence = surface_of(whole())
    mine = label == LABELS.id_of(name)
    least = 0.0 if quantile is None else float(np.quantile(confidence[mine], quantile)) / 255
    mine &= confidence >= np.ceil(least * 255 - 1e-9)
    distance = np.linalg.norm(xyz[mine] - point, axis=1)
    hit = nearest(whole(), name, point, least, unsure=True)
    assert hit is not None
    assert hit.distance_m == pytest.approx(distance.min(), abs=1e-9)
    candidates = np.flatnonzero(distance <= distance.min() + 1e-9)
    chosen = candidates[np.linalg.norm(xyz[mine][candidates] - hit.xyz, axis=1).argmin()]
    np.testing.assert_allclose(hit.xyz, xyz[mine][chosen], atol=1e-9)
    assert hit.confidence == pytest.approx(confidence[mine][chosen] / 255)


def test_a_class_that_is_nowhere() -> None:
    assert nearest(whole(), "lamp", (0, 0, 0)) is None
    assert nearest(whole(), "cup", (0, 0, 0), 1.0) is None
    with pytest.raises(MapError, match="min_confidence"):
        nearest(whole(), "cup", (0, 0, 0), 1.5)
    with pytest.raises(LabelError, match=r"no class 'lmap'; did you mean `lamp`"):
        nearest(whole(), "lmap", (0, 0, 0))
