"""A mirror is its map, however it was fed; its snapshots never change."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import LabelError, MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.files.map_file import CHUNK_BLOCKS
from semantic_mapper.mapping.storage.changes import BlockChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries import mirror as mirror_module
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import at, nearest
from semantic_mapper.queries.rays import cast_rays
from semantic_mapper.queries.snapshot import MapSnapshot
from tests.mapping.rendered_views import frame, small_map
from tests.mapping.storage.test_paging import MEMORY_MB, walk
from tests.queries.random_map import random_map
from tests.queries.scene import FLOOR, LABELS, TABLE, integrate, painted, poses, seen, whole_map

ROOT = Path(__file__).resolve().parents[2]


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


def test_a_saved_map_has_the_same_mirror(tmp_path: Path) -> None:
    voxel_map = whole_map()
    voxel_map.save(tmp_path / "map.npz")
    loaded = type(voxel_map).load(tmp_path / "map.npz")
    assert_same(MapMirror.of(loaded).snapshot(), MapMirror.of(voxel_map).snapshot())


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


def test_queries_see_whole_versions_while_another_thread_applies() -> None:
    """Every version paints all of the surface in one class: an answer that mixes versions would show two."""
    mirror = empty_mirror()
    mirror.apply(painted(np.full((32, 32), FLOOR, np.uint8), 0, 1))
    plans = {c: painted(np.full((32, 32), c, np.uint8), 0, 1) for c in (FLOOR, TABLE)}
    stop, wrong, asked = threading.Event(), [], [0] * 3
    places = np.stack(np.meshgrid(np.arange(32), np.arange(32), [3.3]), -1).reshape(-1, 3)[::7] * 0.02

    def ask(who: int) -> None:
        while not stop.is_set() or asked[who] < 5:
            snapshot = mirror.snapshot()
            want = FLOOR if snapshot.version % 2 else TABLE
            label = at(snapshot, places).label
            rays = cast_rays(snapshot, places + np.array([0, 0, 0.06]), (0.0, 0.0, -1.0)).label
            other = nearest(snapshot, "table" if want == FLOOR else "floor", places[5])
            if (label != want).any() or (rays != want).any() or other is not None:
                wrong.append(snapshot.version)
            asked[who] += 1

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    for version in range(2, 400):
        plan: BlockChanges = plans[FLOOR if version % 2 else TABLE]
        mirror.apply(dataclasses.replace(plan, since=version - 1, version=version))
    stop.set()
    for thread in threads:
        thread.join()
    assert not wrong and min(asked) >= 5


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


def test_of_an_empty_saved_map_there_is_an_empty_mirror(tmp_path: Path) -> None:
    small_map(LABELS).save(tmp_path / "map.npz")
    assert MapMirror.load(tmp_path / "map.npz").snapshot().block_count == 0


def test_a_saved_map_is_mirrored_without_its_class_evidence_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    ids = tuple(range(1, 61))
    many = LabelSet("many", ids, tuple(f"class {n}" for n in ids), ((0, 0, 0),) * len(ids))
    voxel_map = small_map(many, voxel_size_m=0.006)
    pose = poses(1)[0]
    depth, _ = seen(pose)
    voxel_map.integrate(frame(pose), depth, np.full((*depth.shape, len(many)), 1 / len(many), np.float32), None)
    voxel_map.save(path)

    def peak_bytes(load: Callable[[], object]) -> int:
        tracemalloc.start()
        load()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    assert peak_bytes(lambda: MapMirror.load(path)) < 0.75 * peak_bytes(lambda: VoxelMap.load(path))


def test_a_damaged_map_has_no_mirror(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    whole_map().save(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"map\.npz: chunk .*damaged"):
        MapMirror.load(path)


def test_a_mirror_needs_no_open3d() -> None:
    program = (
        "import sys, numpy as np\n"
        "from tests.queries.scene import LABELS, TABLE, painted\n"
        "from semantic_mapper.queries.surface import points_in_box\n"
        "from semantic_mapper.queries.instances import InstanceTracker\n"
        "from semantic_mapper.queries.mirror import MapMirror\n"
        "snapshot = MapMirror(0.02, 4.0, LABELS).apply(painted(np.full((8, 8), TABLE, np.uint8), 0, 1))\n"
        "print(len(points_in_box(snapshot, (-1, -1, -1), (1, 1, 1)).xyz), len(InstanceTracker().update(snapshot)))\n"
        "print('open3d' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.stdout.split() == ["64", "1", "False"], done.stderr


def test_classes_of_a_block_are_those_of_its_voxels_near_the_surface() -> None:
    snapshot = random_map(0)
    voxels = snapshot.voxels
    for slot in snapshot.slots:
        near = (voxels.weight[slot] > 0) & (np.abs(voxels.tsdf[slot].astype(int)) <= 60)
        expected = set(voxels.label[slot][near].tolist()) - {LABELS.ignore_id}
        bits = [int(word) >> bit & 1 for word in voxels.classes[slot] for bit in range(64)]
        assert set(np.flatnonzero(bits).tolist()) == expected
