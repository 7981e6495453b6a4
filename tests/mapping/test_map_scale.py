"""A map whose lengths are not metres stays one wherever it goes."""

from __future__ import annotations

import json
import zipfile
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


def manifest(path: Path) -> dict[str, object]:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("manifest.json"))


def test_a_saved_map_says_it_and_one_in_metres_reads_as_before(tmp_path: Path) -> None:
    a_map(scale_known=False).save(tmp_path / "unknown.npz")
    assert manifest(tmp_path / "unknown.npz")["scale"] == "unknown"
    assert not describe_map(tmp_path / "unknown.npz").scale_known
    loaded = VoxelMap.load(tmp_path / "unknown.npz")
    assert not loaded.scale_known
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "unknown.npz").read_bytes()
    a_map(scale_known=True).save(tmp_path / "known.npz")
    assert manifest(tmp_path / "known.npz")["scale"] != "unknown"
    assert VoxelMap.load(tmp_path / "known.npz").scale_known


def test_merging_keeps_it_and_never_mixes() -> None:
    known, unknown = a_map(scale_known=True), a_map(scale_known=False)
    assert not unknown.merged(unknown, np.eye(4)).scale_known
    assert known.merged(known, np.eye(4)).scale_known
    for one, other in ((known, unknown), (unknown, known)):
        with pytest.raises(MapError, match=r"scale of the other is unknown; .*--distance.*--camera-height"):
            one.merged(other, np.eye(4))


def test_a_corrected_or_resumed_map_keeps_it() -> None:
    live, rebuilt = a_map(scale_known=False), a_map(scale_known=True)
    live.take_over(rebuilt)  # the corrector builds its map from frames, which do not say it
    fresh = small_map()
    fresh.take_over(a_map(scale_known=False))
    assert not live.scale_known and not fresh.scale_known
