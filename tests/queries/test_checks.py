"""Whatever is asked wrongly is refused in words, by every query."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.queries import nearest, occupancy, surface
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.snapshot import MapSnapshot
from tests.queries.scene import whole

NAN = float("nan")


@pytest.mark.parametrize("query", [nearest.at, occupancy.occupancy])
@pytest.mark.parametrize(
    ("points", "match"),
    [
        ([[0, 0, NAN]], "row 0 is .*nan"),
        ([[0, 0, 0], [0, np.inf, 0]], "row 1"),
        ([[0, 0, 1e9]], "coordinates must be numbers below"),
        ([0, 0, 0], r"expected shape \(N, 3\), got \(3,\)"),
        ([[0, 0]], r"got \(1, 2\)"),
        ([["a", "b", "c"]], "expected numbers"),
        ([[0, 0, 0], [1]], "expected numbers"),
    ],
)
def test_points(query: Callable[..., Any], points: Any, match: str) -> None:
    with pytest.raises(MapError, match=match):
        query(whole(), points)
    assert len(nearest.at(whole(), np.empty((0, 3))).label) == 0


def test_radius_and_point() -> None:
    for radius in (0.0, NAN, 0.6):
        with pytest.raises(MapError, match=r"above 0, at most 0\.5"):
            nearest.at(whole(), [[0, 0, 0]], radius)
    for point in ((0, 0), [(0, 0, 0)], (0, 0, NAN)):
        with pytest.raises(MapError, match="point"):
            nearest.nearest(whole(), "cup", point)


@pytest.mark.parametrize("query", [surface.points_in_box, occupancy.distance_field])
def test_box(query: Callable[..., Any]) -> None:
    for lower, upper, match in (
        ((0, 0, 0), (1, 0, 1), "is empty"),
        ((0, 0, 0), (1, -1, 1), "is empty"),
        ((0, 0, NAN), (1, 1, 1), "lower"),
        ((0, 0, 0), (1, 1), "upper"),
    ):
        with pytest.raises(MapError, match=match):
            query(whole(), lower, upper)


def test_boxes_that_hold_too_much_or_nothing() -> None:
    with pytest.raises(MapError, match=r"501 x 501 x 501 voxels of 0.02 m.*smaller box"):
        occupancy.distance_field(whole(), (0, 0, 0), (10, 10, 10))
    with pytest.raises(MapError, match="smaller box"):
        occupancy.distance_field(whole(), (-8e4, -8e4, -8e4), (8e4, 8e4, 8e4))
    with pytest.raises(MapError, match="larger box"):
        occupancy.distance_field(whole(), (0.001, 0, 0), (0.019, 1, 1))


def test_rays() -> None:
    def refused(match: str, *arguments: Any) -> None:
        with pytest.raises(MapError, match=match):
            surface.cast_rays(whole(), *arguments)

    refused("directions: .* above 0", (0, 0, 0), (0, 0, 0))
    refused("directions", (0, 0, 0), (0, NAN, 1))
    refused("directions: expected shape", (0, 0, 0), (1, 0))
    refused("origins", (0, NAN, 0), (0, 0, 1))
    refused("2 origins and 3 directions", np.zeros((2, 3)), np.ones((3, 3)))
    for far in (1e6, 0.0, NAN):
        refused("max_m must be above 0, at most 100", (0, 0, 0), (0, 0, 1), far)


WITH_METRES: tuple[Callable[[MapSnapshot], object], ...] = (
    lambda s: nearest.at(s, [(0, 0, 0)]),
    lambda s: nearest.nearest(s, "cup", (0, 0, 0)),
    lambda s: surface.cast_rays(s, (0, 0, 1), (0, 0, -1)),
    lambda s: surface.points_in_box(s, (-1, -1, -1), (1, 1, 1)),
    lambda s: occupancy.occupancy(s, [(0, 0, 0)]),
    lambda s: occupancy.distance_field(s, (-1, -1, -1), (1, 1, 1)),
    lambda s: InstanceTracker().update(s),
)


@pytest.mark.parametrize("query", WITH_METRES)
def test_metres_are_refused_where_the_scale_is_unknown(query: Callable[[MapSnapshot], object]) -> None:
    query(whole())
    with pytest.raises(MapError, match=r"the scale is unknown; .semantic-mapper scale"):
        query(dataclasses.replace(whole(), scale_known=False))
