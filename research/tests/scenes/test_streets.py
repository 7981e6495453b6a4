"""Streets of STREETS: they follow from seed and number, hold what they should, and boxes and predictions are as bad as
promised."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import pytest

from research.scenes.scene import scene_at
from research.scenes.sequence import RoomView
from research.scenes.streets.boxes import StreetBox, street_boxes
from research.scenes.streets.layout import make_streets_street
from research.scenes.streets.views import (
    BASELINE_M,
    STEP_M,
    cached_street,
    street_camera,
    street_pairs,
    street_pose,
    street_views,
)
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import KITTI360

CAMERA = street_camera(88)
SEED = 3
# Of what a change may not touch unless it raises ``STREETS_VERSION``.
DIGEST_OF_VERSION_1 = "8aec28b4197bfc8806e9853f518872aa3c63a9a17272c7631fc15d2a1bdda8c9"


@pytest.fixture(scope="module")
def views() -> list[RoomView]:
    return list(street_views(SEED, range(0, 24, 4), CAMERA))


def test_streets_are_those_of_this_version() -> None:
    street, digest = cached_street(SEED), hashlib.sha256()
    p = street.scene.primitives
    for whole in (p.shape, p.label, p.group, p.material, p.instance):
        digest.update(np.ascontiguousarray(whole, np.int64).tobytes())
    boxes = [part for box in street_boxes(street, 1) for part in (box.T_world_box, box.size)]
    for real in (p.center, p.half, p.rotation, street_pose(street, 3), *boxes):
        digest.update(np.round(real * 1e4).astype(np.int64).tobytes())
    assert digest.hexdigest() == DIGEST_OF_VERSION_1


def test_a_pair_is_the_same_whichever_others_are_rendered(views: list[RoomView]) -> None:
    (pair,) = street_pairs(SEED, [4], CAMERA)
    assert np.array_equal(pair.left.frame.rgb, views[1].frame.rgb) and pair.left.frame.seq == 4
    apart = np.linalg.inv(pair.left.T_world_camera) @ pair.right.T_world_camera
    assert np.allclose(apart[:3, 3], (BASELINE_M, 0, 0)) and np.allclose(apart[:3, :3], np.eye(3))
    assert pair.right.frame.depth_m is None and pair.right.frame.label is None
    assert not np.array_equal(pair.right.frame.rgb, pair.left.frame.rgb)
    way = np.linalg.norm(views[1].T_world_camera[:3, 3] - views[0].T_world_camera[:3, 3])
    assert 4 * STEP_M - 0.1 < way < 4 * STEP_M + 0.1


def test_stereo_depth_has_holes_and_errors_that_grow_with_distance(views: list[RoomView]) -> None:
    exact = np.stack([view.rendered.exact_depth_m for view in views])
    depth = np.stack([view.rendered.depth_m for view in views])
    both = (exact > 0) & (depth > 0)
    assert 0.15 < 1 - both.sum() / (exact > 0).sum() < 0.4
    error = np.abs(depth - exact)
    near, far = (np.median(error[both & (exact > low) & (exact < high)]) for low, high in ((2, 8), (20, 50)))
    assert near < 0.1 < far < 4
    filled = (exact == 0) & (depth > 0)
    assert 0 < filled.sum() / (exact == 0).sum() < 0.2, "some of the sky takes the depth of what is beside it"


def test_boxes_are_coarse_but_cover_their_objects(views: list[RoomView]) -> None:
    street = cached_street(SEED)
    boxes = street_boxes(street, 24)
    covered, several = box_overlap(views, boxes)
    assert covered > 0.99 and several > 0.07
    assert len({box.id for box in boxes}) == len(boxes)
    p = street.scene.primitives
    for box in boxes:
        if box.thing:
            own = p.instance == box.id
            assert set(p.label[own].tolist()) == {KITTI360.id_of(box.name)}
            assert box.contains(p.center[own]).all()


def test_cars_drive_if_asked_and_their_boxes_with_them() -> None:
    street = make_streets_street(SEED, moving=True)
    moving = [box for box in street_boxes(street, 5) if box.stamps is not None]
    assert len(moving) == 2 == len(street.scene.walks)
    p = street.scene.primitives
    still = cached_street(SEED).scene
    assert np.array_equal(still.primitives.center, p.center[: len(still.primitives)])
    assert still.daylight is not None and street.scene.daylight is not None
    assert np.array_equal(still.daylight.sun, street.scene.daylight.sun)
    for box in moving:
        own = p.instance == box.id
        assert not p.casts_shadow[own].any()
        assert box.stamps is not None
        way = box.stamps[4][1][:3, 3] - box.stamps[0][1][:3, 3]
        assert np.allclose(scene_at(street.scene, 4).primitives.center[own] - p.center[own], way) and way[0] ** 2 > 4


def box_overlap(views: Sequence[RoomView], boxes: Sequence[StreetBox]) -> tuple[float, float]:
    """Fraction of the surface pixels that lie in a box of their class, and of those in boxes of two classes."""
    names = sorted({box.name for box in boxes})
    covered = several = count = 0
    for view in views:
        exact = view.rendered.exact_depth_m
        points = transform(view.T_world_camera, unproject(exact, view.frame.intrinsics)).reshape(-1, 3)
        points, label = points[exact.ravel() > 0], view.rendered.label.ravel()[exact.ravel() > 0]
        inside = np.zeros((len(names), len(points)), np.bool_)
        for box in boxes:
            inside[names.index(box.name)] |= box.contains(points)
        own = np.array([KITTI360.id_of(name) for name in names])[:, None] == label
        covered, several = covered + (inside & own).any(axis=0).sum(), several + (inside.sum(axis=0) > 1).sum()
        count += len(points)
    return float(covered / count), float(several / count)
