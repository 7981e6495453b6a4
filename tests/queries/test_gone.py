"""A thing that stood in view and left has gone, and when; one that is only no longer found has not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from semantic_mapper.client import MapClient
from semantic_mapper.mapping.blocks import pack_keys
from semantic_mapper.queries.instances import Instance, InstanceTracker
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import surface_points, surface_voxels
from tests.mapping.rendered_views import INTRINSICS, frame, small_map
from tests.nodes.mapper.test_query_service import answering
from tests.queries.scene import CUP, FLOOR, LABELS, TABLE

WALL_M, THING_M = 1.5, 1.0
SIZE = (INTRINSICS.height, INTRINSICS.width)
WHOLE, REST, MOST = slice(30, 130), slice(30, 50), slice(30, 110)  # columns of the thing


class Stage:
    """A wall (floor, as classes go) with a table before it, or a part of one."""

    def __init__(self, **changes: float) -> None:
        self.map = small_map(LABELS, **changes)
        self.mirror = MapMirror.of(self.map)
        self.tracker = InstanceTracker(min_voxels=10)

    def show(self, columns: slice | NDArray[np.int64] | None, *, times: int = 1, class_id: int = TABLE) -> int:
        """Frames with the thing in some columns; returns the stamp of the last."""
        depth, label = np.full(SIZE, WALL_M, np.float32), np.full(SIZE, FLOOR)
        if columns is not None:
            depth[40:90, columns], label[40:90, columns] = THING_M, class_id
        votes = np.where(label[..., None] == np.array(LABELS.ids), 0.85, 0.05).astype(np.float32)
        for _ in range(times):
            self.map.integrate(frame(seq=self.map.frames), depth, votes)
        return self.map.last_stamp_ns

    def look(self) -> tuple[Instance, ...]:
        return self.tracker.update(self.snapshot())

    def snapshot(self) -> MapSnapshot:
        return self.mirror.apply(self.map.changes(self.mirror.version))


@pytest.mark.parametrize("every", [1, 6])
def test_a_thing_that_left_went_at_the_frame_that_cleared_it(every: int) -> None:
    stage = Stage()
    stage.show(WHOLE, times=10)
    (table,) = stage.look()
    stage.show(None, times=2)
    third = stage.show(None)
    for number in range(3, 6):
        if number % every == 0:
            assert len(stage.look()) == (number < 3)
        stage.show(None)
    assert stage.look() == ()
    (gone,) = stage.tracker.gone
    assert (gone.id, gone.class_name, gone.gone_ns, table.gone_ns) == (table.id, "table", third, None)
    np.testing.assert_array_equal(gone.voxels, table.voxels)
    stage.show(WHOLE, times=3)
    (again,) = stage.look()
    assert again.id > table.id and again.gone_ns is None
    assert [thing.id for thing in stage.tracker.gone] == [table.id]


def test_what_is_left_of_a_thing_that_went_is_another_one() -> None:
    stage = Stage()
    stage.show(WHOLE, times=10)
    (table,) = stage.look()
    stage.show(MOST, times=5)
    assert [thing.id for thing in stage.look()] == [table.id] and stage.tracker.gone == ()
    assert len(stage.look()[0].voxels) < 0.9 * len(table.voxels)
    stage.show(REST, times=5)
    (rest,) = stage.look()
    assert rest.id > table.id and [thing.id for thing in stage.tracker.gone] == [table.id]


@pytest.mark.parametrize("reason", ["another class", "nothing is cleared", "another map"])
def test_what_is_only_not_found_has_not_gone(reason: str) -> None:
    stage = Stage(clear_free_space=reason != "nothing is cleared")
    stage.show(WHOLE, times=4)
    (table,) = stage.look()
    if reason == "another class":
        stage.show(WHOLE, times=30, class_id=CUP)
    elif reason == "nothing is cleared":
        stage.show(None, times=30)
    else:
        other = Stage()
        other.show(None, times=4)
        stage.map.take_over(other.map)
    things = stage.look()
    assert all(thing.class_id == CUP or thing.id == table.id for thing in things)
    assert len(things) == (reason != "another map") and stage.tracker.gone == ()


def test_changes_say_which_blocks_lost_surface_and_when() -> None:
    stage = Stage()
    stage.show(WHOLE, times=10)
    since = stage.snapshot().version
    assert len(stage.map.changes(0).cleared.packed) == 0
    third = stage.show(None, times=3)
    stage.show(None, times=3)
    changes = stage.map.changes(since)
    rows = changes.cleared
    assert rows.voxels.sum() == stage.map.cleared > 0 and (rows.voxels > 0).all()
    assert np.median(np.repeat(rows.stamp_ns, rows.voxels)) == third
    assert np.isin(rows.packed, pack_keys(changes.keys)).all()
    assert len(stage.map.changes(changes.version).cleared.packed) == 0
    step = stage.map.changes(since, limit=1)  # whole versions only, and of the rows those
    assert (step.cleared.version <= step.version).all()
    follower = MapMirror.of(stage.map)
    for mine, theirs in zip(follower.snapshot().cleared, rows, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert len(follower.apply(dataclasses.replace(changes, since=0)).cleared.packed) == len(rows.packed)  # not twice


def thing_points(snapshot: MapSnapshot) -> int:
    xyz = surface_points(snapshot, surface_voxels(snapshot)).xyz
    return int((np.abs(xyz[:, 2] - THING_M) < 0.1).sum())


def test_a_client_gets_what_is_gone_and_its_mirror_keeps_no_ghost(tmp_path_factory: pytest.TempPathFactory) -> None:
    stage, folder = Stage(), tmp_path_factory.mktemp("q")

    def answered(client: MapClient, *, gone: bool) -> tuple[Instance, ...]:
        things = client.instances(gone=gone)
        while client.version < stage.map.version:  # an answer may be about the map of a moment ago
            things = client.instances(gone=gone)
        while client.mirror().version < stage.map.version:
            pass
        return things

    with answering(f"ipc://{folder / 'q'}", stage.map) as service, MapClient(service.endpoint, timeout_s=60) as client:
        stage.show(WHOLE, times=10)
        (table,) = answered(client, gone=True)
        assert table.gone_ns is None and thing_points(client.mirror().snapshot()) > 100
        stage.show(None, times=2)
        third = stage.show(None)
        stage.show(None)
        assert answered(client, gone=False) == ()
        (gone,) = answered(client, gone=True)
        assert (gone.id, gone.gone_ns) == (table.id, third)
        np.testing.assert_array_equal(gone.voxels, table.voxels)
        assert thing_points(client.mirror().snapshot()) == thing_points(MapMirror.of(stage.map).snapshot()) == 0
