"""A backup is the map of the moment it was begun, however slowly it is copied and whatever frames do meanwhile."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping import map_backup
from semantic_mapper.mapping.block_store import BlockStore
from semantic_mapper.mapping.map_backup import MapBackup
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.test_correction import drift, drifted, finish, make_pipeline, mapped, same
from tests.mapping.test_paging import MEMORY_MB, walk
from tests.mapping.views import LABELS, small_map
from tests.small import tiny_frames


def state(voxel_map: VoxelMap) -> dict[str, bytes]:
    return {name: a.tobytes() for name, a in voxel_map.block_state().items()}


def restored(backup: MapBackup, like: VoxelMap) -> VoxelMap:
    voxel_map, done = VoxelMap(like.config, LABELS), 0
    while done < len(backup):
        done = backup.restore(voxel_map, done)
    return voxel_map


@pytest.mark.parametrize(("memory_mb", "evidence"), [(0, "float32"), (MEMORY_MB, "float32"), (0, "int16")])
@pytest.mark.parametrize("most_aside", [10, 10**6])
def test_it_is_of_its_moment_although_frames_go_on(
    memory_mb: int, evidence: str, most_aside: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_backup, "_MOST_ASIDE", most_aside)
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=memory_mb, evidence=evidence)
    walk(voxel_map, 6)
    before = state(voxel_map)
    backup = MapBackup(voxel_map)
    rounds = 0
    while not backup.is_whole:
        walk(voxel_map, 1, first=rounds % 5)
        assert len(backup._aside) <= most_aside
        backup.go_on(90)
        rounds += 1
    assert rounds >= len(backup) // 90 and not voxel_map._grid.watchers
    assert state(voxel_map)["tsdf"] != before["tsdf"]
    again = restored(backup, voxel_map)
    assert state(again) == before and (again.frames, again.version) == (6, 6)
    walk(voxel_map, 1)
    backup.close()


def test_it_is_copied_by_another_thread_as_well() -> None:
    voxel_map = small_map(voxel_size_m=0.01)
    walk(voxel_map, 4)
    before, backup = state(voxel_map), MapBackup(voxel_map)

    def copy() -> None:
        while not backup.is_whole:
            backup.go_on(7)

    copier = threading.Thread(target=copy)
    copier.start()
    walk(voxel_map, 6)
    copier.join()
    assert state(restored(backup, voxel_map)) == before


def test_a_disk_that_fails_is_told_to_the_backup_and_not_to_the_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    voxel_map = small_map(voxel_size_m=0.01)
    walk(voxel_map, 3)
    backup = MapBackup(voxel_map)
    monkeypatch.setattr(map_backup, "_MOST_ASIDE", 5)
    backup._store._database.execute("DROP TABLE blocks")
    walk(voxel_map, 1)
    with pytest.raises(MapError, match="cannot be put on disk"):
        backup.go_on(1)
    backup.close()
    assert not voxel_map._grid.watchers and voxel_map.frames == 4


def test_a_step_copies_no_more_than_its_portion(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[int] = []
    put = BlockStore.put_packed

    def counted(store: BlockStore, keys: np.ndarray, *rest: object) -> None:
        written.append(len(keys))
        put(store, keys, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(BlockStore, "put_packed", counted)
    monkeypatch.setattr("semantic_mapper.mapping.correction.LEAST_BACKED_UP", 10)
    frames = tiny_frames(14)
    pipeline = make_pipeline(max_frames=8)
    a_step: list[int] = []
    for frame in frames:
        written.clear()
        pipeline.step(frame)
        a_step.append(sum(written))
    blocks = pipeline.voxel_map.block_count
    assert pipeline.corrector.status.frozen > 0 and sum(a_step) > 2 * blocks // 3
    assert max(a_step) <= -(-2 * blocks // 4)  # the half full history has 4 frames
    assert sum(n > 0 for n in a_step) >= 4


def test_a_correction_that_begins_while_the_backup_is_copied_starts_from_the_right_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("semantic_mapper.mapping.correction.LEAST_BACKED_UP", 1)
    monkeypatch.setattr(map_backup, "RESTORED_AT_ONCE", 30)
    frames = tiny_frames(12)
    late = drifted(frames)
    for count in (5, 7, 8, 9):  # before, in the midst of and after the copying, and with frozen frames
        pipeline = mapped(late[:count], max_frames=8)
        pipeline.correct_poses({f.stamp_ns: f.T_world_camera for f in late[3:count]})
        pipeline.advance_correction(2)
        for frame in late[count:]:
            pipeline.step(frame)
        finish(pipeline)
        assert pipeline.corrector.status.completed == 1 and pipeline.corrector.status.total <= 8
        assert same(pipeline.voxel_map, mapped(late, max_frames=0).voxel_map), count
        pipeline.correct_poses({late[-1].stamp_ns: drift(0.3) @ late[-1].T_world_camera})
        finish(pipeline)
        assert len(pipeline.voxel_map._grid.watchers) <= 1
