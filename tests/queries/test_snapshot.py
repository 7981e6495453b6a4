"""A mirror that is fed from snapshots of another mirror is the map, too."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.queries.snapshot import MapMirror
from tests.mapping.rendered_views import small_map
from tests.queries.scene import FLOOR, LABELS, TABLE, integrate, painted, poses
from tests.queries.test_mirror import assert_same, empty_mirror


def follow(mirror: MapMirror, source: MapMirror, limit: int) -> int:
    """Apply all that the source has, in parts; how many parts that took."""
    parts = 0
    while mirror.version < source.snapshot().version:
        mirror.apply(source.snapshot().changes(mirror.version, limit))
        parts += 1
    return parts


def test_after_a_new_epoch_nothing_of_the_old_one_is_left() -> None:
    voxel_map, corrected = small_map(LABELS), small_map(LABELS)
    source, early, late = empty_mirror(), empty_mirror(), empty_mirror()
    for seq, pose in enumerate(poses(4)):
        integrate(voxel_map, pose, seq)
        shifted = pose.copy()
        shifted[:3, 3] += 0.5
        integrate(corrected, shifted, seq)
    source.apply(voxel_map.changes(0))
    follow(early, source, 0)
    voxel_map.take_over(corrected)
    integrate(voxel_map, poses(1)[0], 9)
    first = voxel_map.changes(source.version, limit=10)
    assert source.apply(first).epoch == source.snapshot().changes(0).epoch == 0 and first.version < voxel_map.version
    while source.version < voxel_map.version:
        source.apply(voxel_map.changes(source.version, limit=10))
    assert source.snapshot().epoch == 1
    most = max(len(source.snapshot().changes(v, 10).keys) for v in range(4, source.snapshot().version))
    assert most < source.snapshot().block_count and follow(early, source, 10) > 1
    integrate(voxel_map, poses(2)[1], 10)
    source.apply(voxel_map.changes(source.snapshot().version))
    assert follow(early, source, 10) == 1
    follow(late, source, 10)
    whole = MapMirror.of(voxel_map).snapshot()
    for mirror in (early, late):
        assert mirror.snapshot().epoch == 1
        assert_same(mirror.snapshot(), whole)


def test_only_what_changed_is_passed_on() -> None:
    source = empty_mirror()
    source.apply(painted(np.full((16, 16), TABLE, np.uint8), 0, 3))
    source.apply(painted(np.full((8, 16), FLOOR, np.uint8), 3, 5))
    assert [len(source.snapshot().changes(since).keys) for since in (0, 2, 3, 4, 5)] == [4, 4, 2, 2, 0]
    first = source.snapshot().changes(0, limit=1)
    assert (first.since, first.version, len(first.keys)) == (0, 3, 2)
    for since, limit in ((-1, 0), (6, 0), (0, -1)):
        with pytest.raises(MapError, match="go from 0 to 5"):
            source.snapshot().changes(since, limit)
