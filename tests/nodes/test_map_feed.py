"""Points as other tools read them."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.nodes import map_feed
from semantic_mapper.nodes.map_feed import thinned, thinning


def points(count: int) -> MapPoints:
    xyz = np.arange(3 * count, dtype=np.float32).reshape(count, 3)
    rgb = np.tile(np.array([[10, 20, 30]], np.uint8), (count, 1))
    measured = np.arange(count) % 2 == 0
    return MapPoints(xyz, rgb, np.arange(count, dtype=np.uint8), np.full(count, 0.2, np.float32), measured)


def test_a_large_map_is_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_feed, "MAX_POINTS", 4)
    few = thinned(points(9))
    assert few.label.tolist() == [0, 3, 6] and few.xyz[1].tolist() == [9, 10, 11]
    assert [thinning(count) for count in (0, 4, 5, 8, 9)] == [1, 1, 2, 2, 3]
