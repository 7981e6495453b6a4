"""Without metres, what takes or gives metres is refused, and what needs none goes on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.nearest import at, nearest
from semantic_mapper.queries.occupancy import distance_field, occupancy
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import cast_rays, points_in_box
from tests.queries.scene import whole

LOW, HIGH = (-1, -1, -1), (1, 1, 1)
WITH_METRES: dict[str, Callable[[MapSnapshot], object]] = {
    "at": lambda s: at(s, [(0, 0, 0)]),
    "nearest": lambda s: nearest(s, "cup", (0, 0, 0)),
    "cast_rays": lambda s: cast_rays(s, (0, 0, 1), (0, 0, -1)),
    "points_in_box": lambda s: points_in_box(s, LOW, HIGH),
    "occupancy": lambda s: occupancy(s, [(0, 0, 0)]),
    "distance_field": lambda s: distance_field(s, LOW, HIGH),
    "instances": lambda s: InstanceTracker().update(s),
}


@pytest.mark.parametrize("name", WITH_METRES)
def test_metres_are_refused(name: str) -> None:
    WITH_METRES[name](whole())
    with pytest.raises(MapError, match=r"the scale is unknown; give a scale.*--distance"):
        WITH_METRES[name](dataclasses.replace(whole(), scale_known=False))
