"""Components against scipy's, boxes against the known scene, and ids that stay while the map grows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.spatial import KDTree

from semantic_mapper.errors import MapError
from semantic_mapper.labels import make_label_set
from semantic_mapper.queries.instances import Instance, InstanceTracker, find_components, thing_voxels, upright_box
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.types import UInt8
from tests.mapping.rendered_views import small_map
from tests.queries.random_map import random_map, voxel_places
from tests.queries.scene import (
    BALL,
    BOX,
    CUP,
    HALF,
    LABELS,
    LAMP,
    TABLE,
    box_axes,
    integrate,
    painted,
    poses,
    voxels_as_changes,
    whole,
)


class Painting:
    """A map of one level surface that is painted over again and again."""

    def __init__(self, min_voxels: int = 1) -> None:
        self.mirror = MapMirror(0.02, 4.0, LABELS)
        self.tracker = InstanceTracker(min_voxels=min_voxels)

    def paint(self, plan: UInt8) -> dict[tuple[int, ...], Instance]:
        """Instances by their first voxel."""
        version = self.mirror.version
        snapshot = self.mirror.apply(painted(plan, version, version + 1))
        return {tuple(thing.voxels[0][:2].tolist()): thing for thing in self.tracker.update(snapshot, unsure=True)}


def test_table_and_cup_are_found_where_they_stand() -> None:
    things = InstanceTracker(min_voxels=200).update(whole())
    assert [thing.class_name for thing in things] in (["table", "cup"], ["cup", "table"])
    by_name = {thing.class_name: thing for thing in things}
    table, cup = by_name["table"], by_name["cup"]
    assert (table.class_id, cup.class_id) == (TABLE, CUP) and {table.id, cup.id} == {1, 2}
    np.testing.assert_allclose(table.box.size, 2 * HALF, atol=0.06)  # votes spill onto the floor
    np.testing.assert_allclose(table.box.center, BOX, atol=0.03)
    turned = np.abs(table.box.R_world_box.T @ box_axes())
    np.testing.assert_allclose(turned, np.eye(3), atol=np.sin(np.deg2rad(4)))
    np.testing.assert_allclose(cup.box.center[:2], BALL[:2], atol=0.02)
    assert np.linalg.norm(cup.centroid - BALL) < 0.1 and cup.confidence > 0.5
    assert np.abs(cup.voxels * 0.02 - BALL).max() < 0.26


def test_ids_stay_while_the_map_grows() -> None:
    voxel_map, mirror = small_map(LABELS), MapMirror(0.02, 4.0, LABELS)
    tracker = InstanceTracker(min_voxels=100)
    ids: dict[str, set[int]] = {"table": set(), "cup": set()}
    sizes = []
    for seq, pose in enumerate(poses(10)):
        integrate(voxel_map, pose, seq)
        things = tracker.update(mirror.apply(voxel_map.changes(mirror.version)))
        for name, known in ids.items():
            largest = max((t for t in things if t.class_name == name), key=lambda t: len(t.voxels))
            known.add(largest.id)
        sizes.append(sum(len(t.voxels) for t in things))
    assert [len(known) for known in ids.values()] == [1, 1] and sizes[-1] > 1.3 * sizes[0]


def test_a_merge_keeps_the_older_id_and_a_split_the_larger_parts() -> None:
    painting, plan = Painting(), np.zeros((32, 32), np.uint8)
    plan[2:6, 2:20] = TABLE
    assert painting.paint(plan)[2, 2].id == 1
    plan[20:30, 2:20] = TABLE
    plan[10, 30] = LAMP
    first = painting.paint(plan)
    assert (first[2, 2].id, sorted(thing.id for thing in first.values())) == (1, [1, 2, 3])
    table = first[20, 2].id
    plan[6:20, 5] = TABLE  # a bridge
    merged = painting.paint(plan)
    assert merged[2, 2].id == 1 and len(merged) == 2
    plan[6:20, 5] = 0
    split = painting.paint(plan)
    assert split[20, 2].id == 1, "the larger part"
    assert split[2, 2].id == 4 and table not in [thing.id for thing in split.values()], "no id is given twice"
    plan[:] = 0
    assert painting.paint(plan) == {}
    plan[2:6, 2:20] = TABLE
    assert painting.paint(plan)[2, 2].id == 5


@settings(max_examples=50, deadline=None)
@given(yaw=st.floats(-7, 7), turn=st.sampled_from((0, np.pi / 4)), seed=st.integers(0, 10**6))
def test_the_box_of_a_box_is_that_box_also_where_it_is_turned_in_its_room(yaw: float, turn: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    up = rng.normal(size=3)
    up /= np.linalg.norm(up)
    a = np.cross(up, rng.normal(size=3))
    a /= np.linalg.norm(a)
    R = np.stack((np.cos(yaw) * a + np.sin(yaw) * np.cross(up, a), np.zeros(3), up), axis=1)
    R[:, 1] = np.cross(up, R[:, 0])
    size, center = np.array([0.7, 0.4, 0.9]), np.array([3.0, -2.0, 1.0])
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T * size
    inner = rng.uniform(-0.5, 0.5, (50, 3)) * size
    room = R @ [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    box = upright_box(np.concatenate((corners, inner)) @ R.T + center, room)
    np.testing.assert_allclose(box.size, size, atol=1e-5)
    np.testing.assert_allclose(box.center, center, atol=1e-5)
    np.testing.assert_allclose(np.abs(box.R_world_box.T @ R), np.eye(3), atol=1e-5)
    assert np.linalg.det(box.R_world_box) == pytest.approx(1) and box.R_world_box[:, 2] == pytest.approx(up)


def test_stray_pieces_are_listed_on_request_only() -> None:
    painting, plan = Painting(), np.zeros((32, 32), np.uint8)
    plan[2:5, 2:6], plan[10:30, 2:30] = TABLE, TABLE
    large, stray = sorted(painting.paint(plan).values(), key=lambda thing: -thing.certainty)
    assert (large.unsure, stray.unsure, len(stray.voxels)) == (False, True, 12)
    snapshot = painting.mirror.snapshot()
    assert [thing.id for thing in InstanceTracker(min_voxels=1).update(snapshot)] == [large.id]
    for unsure, least in ((False, 10), (True, 2)):
        hit = nearest(snapshot, "table", (0, 0, 0), unsure=unsure)
        assert hit is not None and round(hit.xyz[:2].max() / 0.02) == least, unsure


@pytest.mark.parametrize(
    ("name", "apart", "lengths"),
    [("otherprop", 14, [16, 16]), ("cup", 14, [30]), ("cup", 19, [35]), ("cup", 24, [16, 16])],
)
def test_small_things_are_cut_and_near_parts_of_others_joined(name: str, apart: int, lengths: list[int]) -> None:
    place = np.indices((56, 24, 24))
    balls = [np.linalg.norm(place - np.reshape((x, 12, 12), (3, 1, 1, 1)), axis=0) - 8 for x in (12, 12 + apart)]
    distance = np.minimum(*balls)  # voxels
    mirror = MapMirror(0.02, 4.0, make_label_set("one", ("floor", name), ids=(1, 2), ignore_id=0))
    tsdf = np.clip(distance / 4 * 127, -127, 127).astype(np.int8)
    mirror.apply(voxels_as_changes(tsdf, np.where(np.abs(distance) < 2, np.uint8(2), np.uint8(0))))
    things = InstanceTracker().update(mirror.snapshot())
    assert [thing.box.size[0] / 0.02 for thing in things] == pytest.approx(lengths, abs=1.5)


def test_less_is_seen_of_a_box_from_one_side() -> None:
    once = small_map(LABELS)
    integrate(once, poses(10)[0], 0)
    part, all_round = (
        max(InstanceTracker().update(s), key=lambda thing: len(thing.voxels)).seen
        for s in (MapMirror.of(once).snapshot(), whole())
    )
    assert 0.2 < part < 0.7 and all_round > 0.8


def test_settings_that_mean_nothing_are_refused() -> None:
    with pytest.raises(MapError, match="min_voxels must be at least 1"):
        InstanceTracker(min_voxels=0)
    for up in ((0, 0, 0), (0, np.nan, 1), (1, 0), ((0, 0, 1),)):
        with pytest.raises(MapError, match="up"):
            InstanceTracker(up=up)


WANTED = np.isin(np.arange(256), (TABLE, CUP))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("least", [1, 4])
def test_components_of_random_blocks_are_those_of_a_graph_of_all_pairs(seed: int, least: int) -> None:
    snapshot = random_map(seed)
    surface = thing_voxels(snapshot, WANTED)
    found = find_components(surface, least)
    places = voxel_places(snapshot, surface.row, surface.voxel)
    pairs = KDTree(places).query_pairs(1, np.inf, output_type="ndarray")
    a, b = pairs[surface.label[pairs[:, 0]] == surface.label[pairs[:, 1]]].T
    count = len(places)
    graph = sparse.coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    _, expected = sparse.csgraph.connected_components(graph, directed=False)
    members = {number: np.flatnonzero(expected == number) for number in np.unique(expected)}
    large = sorted((part for part in members.values() if len(part) >= least), key=lambda part: part[0])
    parts = np.split(found.order, found.ends)[:-1]
    assert len(parts) == len(large) > 1
    for number, (part, expected_part) in enumerate(zip(parts, large, strict=True)):
        np.testing.assert_array_equal(part, expected_part)
        assert (found.component[part] == number).all()
    assert (found.component >= 0).sum() == sum(map(len, large))
