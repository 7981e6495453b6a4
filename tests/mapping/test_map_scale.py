"""A map whose lengths are not metres stays one wherever it goes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.map_file import describe_map
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.rendered_views import frame, small_map


def a_map(*, scale_known: bool) -> VoxelMap:
    voxel_map = small_map()
    voxel_map.note_scale(scale_known)
    voxel_map.integrate(frame(), np.full((120, 160), 1.0, np.float32), None)
    return voxel_map


def test_it_is_saved_merged_and_taken_over_and_never_mixed(tmp_path: Path) -> None:
    known, unknown = a_map(scale_known=True), a_map(scale_known=False)
    for voxel_map in (known, unknown):
        voxel_map.save(tmp_path / "map.npz")
        assert describe_map(tmp_path / "map.npz").scale_known == voxel_map.scale_known
        loaded = VoxelMap.load(tmp_path / "map.npz")
        assert loaded.scale_known == loaded.merged(loaded, np.eye(4)).scale_known == voxel_map.scale_known
    for one, other in ((known, unknown), (unknown, known)):
        with pytest.raises(MapError, match=r"scale of the other is unknown; .*mapper scale.*--camera-height"):
            one.merged(other, np.eye(4))
    fresh = small_map()
    fresh.take_over(unknown)
    unknown.take_over(known)  # the corrector builds its map from frames, which do not say it
    assert not fresh.scale_known and not unknown.scale_known
