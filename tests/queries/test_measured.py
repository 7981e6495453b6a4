"""Whether a sensor measured the surface goes from the map's voxels into every answer."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy

from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.nearest import at, nearest
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.queries.surface import cast_rays, points_in_box
from tests.mapping.rendered_views import small_map
from tests.queries.scene import BALL, BOX, CUP, HALF, LABELS, TABLE, integrate, poses, whole

LOW, HIGH = (-1.0, -1.0, -1.0), (2.0, 1.0, 1.0)
TABLE_TOP = BOX + np.array([0.0, 0.0, HALF[2]])


@cache
def part_measured() -> VoxelMap:
    """The known scene by computed depth, and by a sensor that saw nothing but the cup."""
    voxel_map = small_map(LABELS)
    for seq, pose in enumerate(poses(14)):
        integrate(voxel_map, pose, seq, measured=False)
        integrate(voxel_map, pose, seq, only=CUP)
    return voxel_map


@pytest.fixture(scope="module", params=["map", "mirror"])
def snapshot(request: pytest.FixtureRequest):
    direct = MapMirror.of(part_measured())
    if request.param == "map":
        return direct.snapshot()
    return MapMirror(0.02, 4.0, LABELS).apply(direct.snapshot().changes(0))


def test_points_say_it_as_those_of_the_map_do(snapshot) -> None:
    points = points_in_box(snapshot, LOW, HIGH)
    assert points.measured is not None
    assert points.measured[points.label == CUP].mean() > 0.9 and points.measured[points.label == TABLE].mean() < 0.1
    of_map = part_measured().points()
    assert of_map.measured is not None and abs(of_map.measured.mean() - points.measured.mean()) < 0.05


def test_nearest_at_and_rays_say_it(snapshot) -> None:
    cup, table = nearest(snapshot, "cup", BALL), nearest(snapshot, "table", TABLE_TOP)
    assert cup is not None and cup.measured and table is not None and not table.measured
    answers = at(snapshot, [cup.xyz, table.xyz, (0.0, 0.0, 9.0)])
    assert answers.measured is not None and answers.measured.tolist() == [True, False, False]
    above = np.array([BALL, TABLE_TOP, (9.0, 9.0, 0.0)])
    hits = cast_rays(snapshot, above + np.array((0, 0, 1)), (0, 0, -1))
    assert hits.measured is not None and hits.measured.tolist() == [True, False, False]


def test_things_have_the_fraction_that_was_measured(snapshot) -> None:
    fraction = {thing.class_name: thing.measured for thing in InstanceTracker().update(snapshot)}
    assert fraction["cup"] > 0.9 and fraction["table"] < 0.1
    assert all(thing.measured == 1 for thing in InstanceTracker().update(whole()))


def test_a_map_made_of_what_was_received_gives_out_the_same() -> None:
    sent = part_measured().changes(0)
    made = VoxelMap.received(sent, 0.02, LABELS)
    again, known = made.changes(0), sent.label != LABELS.ignore_id
    for name in ("keys", "tsdf", "label", "rgb", "computed", "version"):
        np.testing.assert_array_equal(getattr(again, name), getattr(sent, name), name)
    np.testing.assert_array_equal(again.confidence[known], sent.confidence[known])
    points, expected = made.points(), part_measured().points()
    distance, at_row = scipy.spatial.KDTree(expected.xyz).query(points.xyz)
    assert abs(len(distance) - len(expected.xyz)) < 10 and np.quantile(distance, 0.99) < 0.01
    assert expected.measured is not None and (points.measured == expected.measured[at_row]).mean() > 0.999
    assert (points.label == expected.label[at_row]).mean() > 0.99
