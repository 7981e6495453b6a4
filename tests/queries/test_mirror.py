"""A mirror is its map, however it was fed; its snapshots never change."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import LabelError, MapError
from semantic_mapper.mapping import map_file
from semantic_mapper.mapping.map_file import CHUNK_BLOCKS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries import snapshot as mirror_module
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from tests.mapping.rendered_views import small_map
from tests.queries.scene import FLOOR, LABELS, TABLE, integrate, painted, poses


def content(snapshot: MapSnapshot) -> dict[str, np.ndarray]:
    return {"packed": snapshot.packed} | {k: v[snapshot.slots] for k, v in snapshot.voxels._asdict().items()}


def assert_same(a: MapSnapshot, b: MapSnapshot) -> None:
    assert a.version == b.version
    for name, values in content(a).items():
        np.testing.assert_array_equal(values, content(b)[name], err_msg=name)


def empty_mirror() -> MapMirror:
    return MapMirror(0.02, 4.0, LABELS)


def test_fed_in_parts_while_the_map_grows_it_is_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror_module, "LEAST_SPARE", 16)  # the pool is replaced several times
    voxel_map, mirror = small_map(LABELS), empty_mirror()
    monkeypatch.undo()
    pools = set()
    for seq, pose in enumerate(poses(9)):
        integrate(voxel_map, pose, seq)
        mirror.apply(voxel_map.changes(mirror.version, limit=150))
        pools.add(id(mirror.snapshot().voxels.tsdf.ctypes.data))
    while mirror.version < voxel_map.frames:
        mirror.apply(voxel_map.changes(mirror.version, limit=150))
    assert len(pools) > 1
    assert_same(mirror.snapshot(), MapMirror.of(voxel_map).snapshot())
    assert mirror.snapshot().block_count == voxel_map.block_count


def test_a_snapshot_stays_as_it_was() -> None:
    mirror = empty_mirror()
    before = mirror.snapshot()
    first = mirror.apply(painted(np.full((16, 16), TABLE, np.uint8), 0, 1))
    kept = {name: values.copy() for name, values in content(first).items()}
    for version in range(2, 200):
        mirror.apply(painted(np.full((16, 24), FLOOR, np.uint8), version - 1, version))
    assert before.block_count == 0 and nearest(before, "table", (0, 0, 0)) is None
    for name, values in content(first).items():
        np.testing.assert_array_equal(values, kept[name])
    assert nearest(first, "table", (0, 0, 0), unsure=True) and not nearest(mirror.snapshot(), "table", (0, 0, 0))
    assert mirror.snapshot().block_count == 6 and len(mirror.snapshot().voxels.tsdf) < 1000


def test_gaps_and_old_changes_are_refused() -> None:
    mirror, plan = empty_mirror(), np.full((8, 8), TABLE, np.uint8)
    mirror.apply(painted(plan, 0, 3))
    for since, version in ((4, 5), (0, 2)):
        with pytest.raises(MapError, match=r"do not continue a mirror at version 3"):
            mirror.apply(painted(plan, since, version))
    assert mirror.version == 3
    assert mirror.apply(painted(plan, 2, 5)).version == 5  # more than was missing does no harm


def test_damaged_changes_are_refused_and_leave_the_mirror_as_it_was() -> None:
    mirror, good = empty_mirror(), painted(np.full((16, 8), TABLE, np.uint8), 0, 1)

    def refused(error: type[Exception], match: str, **changed: np.ndarray) -> None:
        with pytest.raises(error, match=match):
            mirror.apply(dataclasses.replace(good, **changed))

    refused(MapError, "tsdf must be int8", tsdf=good.tsdf[:1])
    refused(MapError, "rgb must be uint8", rgb=good.rgb.astype(np.int16))
    refused(MapError, "a block comes twice", keys=good.keys[[0, 0]])
    refused(MapError, "block coordinates beyond", keys=good.keys + (1 << 22))
    refused(LabelError, r"class ids \[77\]", label=np.where(good.label > 0, 77, 0).astype(np.uint8))
    assert mirror.version == 0 and mirror.snapshot().block_count == 0


def test_a_mirror_of_a_saved_map_is_that_of_the_loaded_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_file, "_CHUNKS_AT_ONCE", 1)
    voxel_map = VoxelMap(VoxelMapConfig(unknown_below=0.6), LABELS)
    for seq, pose in enumerate(poses(4)):
        integrate(voxel_map, pose, seq)
    voxel_map.note_scale(False)
    voxel_map.save(tmp_path / "map.npz")
    assert voxel_map.block_count > CHUNK_BLOCKS  # more than one chunk
    loaded, of_loaded = MapMirror.load(tmp_path / "map.npz"), MapMirror.of(VoxelMap.load(tmp_path / "map.npz"))
    a, b = loaded.snapshot(), of_loaded.snapshot()
    assert_same(a, b)
    names = ("epoch", "voxel_size_m", "truncation_voxels", "label_set", "scale_known")
    assert [getattr(a, name) for name in names] == [getattr(b, name) for name in names]
    np.testing.assert_array_equal(a.versions, b.versions)
    assert loaded.is_whole


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
    for mirror in (source, early, late):
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
        with pytest.raises(MapError, match="versions 0 to 5"):
            source.snapshot().changes(since, limit)
