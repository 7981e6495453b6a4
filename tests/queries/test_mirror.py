"""A mirror is its map, however it was fed; its snapshots never change."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import LabelError, MapError
from semantic_mapper.mapping.map_file import CHUNK_BLOCKS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries import snapshot as mirror_module
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from tests.mapping.rendered_views import small_map
from tests.mapping.test_paging import MEMORY_MB, walk
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


def test_a_map_that_was_replaced_by_a_corrected_one_leaves_nothing_of_the_old_one() -> None:
    voxel_map, corrected, mirror = small_map(LABELS), small_map(LABELS), empty_mirror()
    for seq, pose in enumerate(poses(4)):
        integrate(voxel_map, pose, seq)
        shifted = pose.copy()
        shifted[:3, 3] += 0.5
        integrate(corrected, shifted, seq)
    mirror.apply(voxel_map.changes(0))
    old = mirror.snapshot()
    voxel_map.take_over(corrected)
    integrate(voxel_map, poses(1)[0], 8)  # blocks that it touches come last
    parts = 0
    while mirror.version < voxel_map.version:
        assert mirror.snapshot() is old and mirror.is_whole == (parts == 0)
        mirror.apply(voxel_map.changes(mirror.version, limit=10))
        parts += 1
    assert parts > 1 and mirror.is_whole
    assert mirror.snapshot().epoch == voxel_map.epoch == 1
    assert_same(mirror.snapshot(), MapMirror.of(voxel_map).snapshot())
    integrate(voxel_map, poses(1)[0], 9)
    mirror.apply(voxel_map.changes(mirror.version))
    assert_same(mirror.snapshot(), MapMirror.of(voxel_map).snapshot())


def test_a_paged_map_has_the_same_mirror() -> None:
    free, paged = small_map(voxel_size_m=0.01), small_map(voxel_size_m=0.01, memory_mb=MEMORY_MB)
    mirror = MapMirror(0.01, 4.0, paged.label_set)
    for n in range(8):
        for voxel_map in (free, paged):
            walk(voxel_map, 1, first=n)
        mirror.apply(paged.changes(mirror.version, limit=300))
    while mirror.version < paged.frames:
        mirror.apply(paged.changes(mirror.version, limit=300))
    assert paged.stored_blocks > 100
    assert_same(mirror.snapshot(), MapMirror.of(free).snapshot())
    assert_same(MapMirror.of(paged).snapshot(), MapMirror.of(free).snapshot())


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
    assert nearest(first, "table", (0, 0, 0)) and not nearest(mirror.snapshot(), "table", (0, 0, 0))
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


def test_a_mirror_of_a_saved_map_is_that_of_the_loaded_one(tmp_path: Path) -> None:
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
