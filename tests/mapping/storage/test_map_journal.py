"""A journal has the map as it was at each of its moments, whatever frames do meanwhile, and holds only what changed."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage import grid_snapshots
from semantic_mapper.mapping.storage.block_store import BlockStore
from semantic_mapper.mapping.storage.map_journal import MapJournal
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.correction.test_corrected_map import drift, drifted, finish, make_pipeline, mapped, same
from tests.mapping.rendered_views import INTRINSICS, LABELS, small_map
from tests.mapping.storage.test_paging import MEMORY_MB, STEP_M, along_the_wall, walk
from tests.small import tiny_frames


def state(voxel_map: VoxelMap) -> dict[str, bytes]:
    return {name: a.tobytes() for name, a in voxel_map.block_state().items()}


def restored(journal: MapJournal, like: VoxelMap) -> VoxelMap:
    voxel_map, keys = VoxelMap(like.config, LABELS), journal.oldest_keys()
    for start in range(0, max(1, len(keys)), 100):
        journal.restore(voxel_map, keys[start : start + 100])
    return voxel_map


@pytest.mark.parametrize(("memory_mb", "evidence"), [(0, "float32"), (MEMORY_MB, "float32"), (0, "int16")])
@pytest.mark.parametrize("most_in_memory", [10, 10**6])
def test_each_moment_comes_back_although_frames_go_on(
    memory_mb: int, evidence: str, most_in_memory: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grid_snapshots, "MOST_IN_MEMORY", most_in_memory)
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=memory_mb, evidence=evidence)
    journal, before = MapJournal(voxel_map, 0), {0: (state(voxel_map), 0)}
    for number, first in ((3, 0), (7, 2), (9, 1), (12, 4)):  # goes back to where it was, and further
        walk(voxel_map, 3, first)
        journal.mark(number)
        before[number] = state(voxel_map), voxel_map.frames
        assert journal.in_memory <= most_in_memory
        journal.write(50)
    walk(voxel_map, 2)
    for number, (then, frames) in before.items():
        assert journal.numbers[0] == number and then["tsdf"] != state(voxel_map)["tsdf"]
        again = restored(journal, voxel_map)
        assert state(again) == then and again.frames == again.version == frames, number
        walk(voxel_map, 1, first=3)
        if number < 12:
            journal.forget_oldest()
    journal.close()
    assert not voxel_map._grid.watchers


def test_a_moment_takes_no_more_room_than_what_changes_until_the_next() -> None:
    voxel_map = small_map(voxel_size_m=0.01)
    walk(voxel_map, 8)
    journal = MapJournal(voxel_map, 0)
    version = voxel_map.version
    walk(voxel_map, 1, first=3)
    changed = len(voxel_map.changed_since(version))
    journal.write()
    walk(voxel_map, 1, first=3)
    assert 0 < changed < voxel_map.block_count / 3 and journal.in_memory == 0
    assert len(journal._snapshots._moments[0].store) == changed
    journal.mark(1)
    journal.forget_oldest()
    assert len(journal._snapshots._moments[0].store) == 0 and len(journal.oldest_keys()) == voxel_map.block_count


def test_another_thread_writes_and_restores_as_well() -> None:
    voxel_map = small_map(voxel_size_m=0.01)
    walk(voxel_map, 4)
    before, journal = state(voxel_map), MapJournal(voxel_map, 0)
    found: list[dict[str, bytes]] = []
    done = threading.Event()

    def read() -> None:
        while not done.is_set() or not found:
            journal.write(7)
            found.append(state(restored(journal, voxel_map)))

    reader = threading.Thread(target=read)
    reader.start()
    walk(voxel_map, 6)
    done.set()
    reader.join()
    assert found and all(one == before for one in found)


def test_a_disk_that_fails_is_told_to_the_journal_and_not_to_the_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    voxel_map = small_map(voxel_size_m=0.01)
    walk(voxel_map, 3)
    journal = MapJournal(voxel_map, 0)
    monkeypatch.setattr(grid_snapshots, "MOST_IN_MEMORY", 5)
    journal._snapshots._moments[0].store._database.execute("DROP TABLE blocks")
    walk(voxel_map, 1)
    with pytest.raises(MapError, match="cannot be put on disk"):
        journal.write(1)
    journal.close()
    assert not voxel_map._grid.watchers and voxel_map.frames == 4


def test_a_disk_that_is_full_for_a_while_takes_nothing_from_the_journal() -> None:
    voxel_map = small_map(voxel_size_m=0.01)
    walk(voxel_map, 3)
    journal, before = MapJournal(voxel_map, 0), state(voxel_map)
    walk(voxel_map, 3)
    database, waiting = journal._snapshots._moments[0].store._database, journal.in_memory
    (pages,) = database.execute("PRAGMA page_count").fetchone()
    database.execute(f"PRAGMA max_page_count = {pages + 1}")
    with pytest.raises(MapError, match="disk is full"):
        journal.write()
    assert journal.in_memory == waiting > 300
    database.execute("PRAGMA max_page_count = 1000000")
    assert state(restored(journal, voxel_map)) == before


def test_looking_at_a_map_on_disk_is_no_change_of_it() -> None:
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=MEMORY_MB)
    walk(voxel_map, 8)
    journal = MapJournal(voxel_map, 0)
    stored = set(map(tuple, voxel_map._grid.stored_keys().tolist()))
    for n in range(2):
        assert (voxel_map.ray_cast(along_the_wall(n * STEP_M), INTRINSICS).depth_m > 0).any()
    assert stored - set(map(tuple, voxel_map._grid.stored_keys().tolist()))  # came back to be looked at
    journal.write()
    assert len(journal._snapshots._moments[0].store) == 0


def test_a_step_puts_a_bounded_part_on_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[int] = []
    put = BlockStore.put_packed

    def counted(store: BlockStore, keys: np.ndarray, *rest: object) -> None:
        written.append(len(keys))
        put(store, keys, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(BlockStore, "put_packed", counted)
    monkeypatch.setattr("semantic_mapper.mapping.correction.corrected_map.LEAST_WRITTEN", 10)
    frames = tiny_frames(14)
    pipeline = make_pipeline(max_frames=8)
    a_step: list[int] = []
    for frame in frames:
        journal = pipeline.corrector._journal
        waiting = 0 if journal is None else journal.in_memory
        written.clear()
        pipeline.step(frame)
        assert sum(written) <= max(10, waiting // 8)
        a_step.append(sum(written))
    assert pipeline.corrector.status.frozen > 0 and sum(n > 0 for n in a_step) >= 8


def test_a_correction_that_begins_while_the_journal_is_written_starts_from_the_right_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("semantic_mapper.mapping.correction.corrected_map.LEAST_WRITTEN", 1)
    monkeypatch.setattr("semantic_mapper.mapping.correction.corrected_map.RESTORED_AT_ONCE", 30)
    frames = tiny_frames(12)
    late = drifted(frames)
    for count in (5, 7, 8, 9):  # before and after the first frames are frozen
        pipeline = mapped(late[:count], max_frames=5, moving={"motion": False})  # which a correction lets forget
        pipeline.correct_poses({f.stamp_ns: f.T_world_camera for f in late[3:count]})
        pipeline.advance_correction(2)
        for frame in late[count:]:
            pipeline.step(frame)
        finish(pipeline)
        assert pipeline.corrector.status.completed == 1 and pipeline.corrector.status.total <= 8
        assert same(pipeline.voxel_map, mapped(late, max_frames=0, moving={"motion": False}).voxel_map), count
        pipeline.correct_poses({late[-1].stamp_ns: drift(0.3) @ late[-1].T_world_camera})
        finish(pipeline)
        assert len(pipeline.voxel_map._grid.watchers) <= 1
