from functools import cache
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from msgspec.structs import replace as with_settings

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import MapError
from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.localization.features import (
    Features,
    find_place_features,
    match_features,
    pose_from_features,
    pose_from_points,
)
from semantic_mapper.localization.places import Place, PlaceStore, rank_places
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.drawn_room import walk_frames

INTRINSICS = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)


@cache
def walk() -> tuple[PosedFrame, ...]:
    """Every third of 24 frames through a furnished room."""
    return walk_frames(7, 24, INTRINSICS, step_m=0.06)[::3]


def features_of(frame: PosedFrame, light: float = 1.0) -> Features:
    assert frame.depth_m is not None
    rgb = np.clip(frame.rgb * light, 0, 255).astype(np.uint8)
    return find_place_features(rgb, frame.depth_m, 300)


def test_a_place_is_found_among_others_in_weaker_light() -> None:
    places = {number: features_of(frame).descriptors for number, frame in enumerate(walk())}
    for number, frame in enumerate(walk()):
        assert rank_places(features_of(frame, 0.5), places, 3)[0][0] == number


def test_the_pose_between_two_views_comes_of_their_features() -> None:
    a, b = walk()[0], walk()[1]
    found = pose_from_features(features_of(b), features_of(a), INTRINSICS, 12)
    assert found is not None
    off = invert_pose(invert_pose(a.T_world_camera) @ b.T_world_camera) @ found[0]
    assert np.linalg.norm(off[:3, 3]) < 0.05 and np.rad2deg(np.linalg.norm(rotation_vector(off))) < 1.5


def test_images_without_features_match_nothing() -> None:
    flat = find_place_features(np.full((48, 64, 3), 90, np.uint8), np.ones((48, 64), np.float32), 100)
    assert len(flat.pixels) == 0 and flat.descriptors.shape == (0, 128)
    assert match_features(flat.descriptors, features_of(walk()[0]).descriptors).shape == (0, 2)
    assert rank_places(flat, {0: features_of(walk()[0]).descriptors}, 3) == []
    same = np.tile([[0.1, 0.2, 1.0]], (12, 1))
    assert pose_from_points(same, np.tile([[92.7, 85.9]], (12, 1)), INTRINSICS, 12, 4.0) is None


DEFAULTS = MapperConfig()


def mapped(config: MapperConfig = DEFAULTS) -> VoxelMap:
    mapper = Mapper.load(None, with_settings(config, voxel_map=with_settings(config.voxel_map, voxel_size_m=0.05)))
    for frame in walk()[:3]:
        mapper.step(frame)
    return mapper.pipeline.voxel_map


def test_a_map_keeps_its_places_in_its_file(tmp_path: Path) -> None:
    voxel_map = mapped()
    voxel_map.save(tmp_path / "map.npz")
    again = VoxelMap.load(tmp_path / "map.npz").places.places
    assert len(again) >= 2 and all(len(p.points) > 20 for p in again)
    for a, b in zip(voxel_map.places.places, again, strict=True):
        assert (a.camera_id, a.stamp_ns) == (b.camera_id, b.stamp_ns)
        assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("T_world_camera", "points", "descriptors"))


def test_places_that_are_no_poses_are_refused(tmp_path: Path) -> None:
    voxel_map = mapped()
    bad = voxel_map.places.places[0]
    voxel_map.places.add(Place("c", 1, np.diag([2.0, 1, 1, 1]), bad.points, bad.descriptors))
    voxel_map.save(tmp_path / "map.npz")
    with pytest.raises(MapError, match="its places"):
        VoxelMap.load(tmp_path / "map.npz")


def test_a_place_in_the_making_counts_at_once_and_is_waited_for_where_it_is_read() -> None:
    store, go_on = PlaceStore(), Event()
    place = Place("c", 1, np.eye(4), np.zeros((1, 3), np.float32), np.zeros((1, 128), np.uint8))

    def make() -> Place:
        assert go_on.wait(60)
        return place

    store.add_soon(np.eye(4), make)
    assert not store.wants(np.eye(4)) and len(store) == 1
    go_on.set()
    assert store.places == (place,)

    def fail() -> Place:
        raise MemoryError("no room")

    elsewhere = np.diag([-1.0, -1, 1, 1])
    store.add_soon(elsewhere, fail)
    with pytest.raises(MemoryError):
        _ = store.places
    assert store.places == (place,) and store.wants(elsewhere)


def test_a_full_store_lets_the_most_crowded_place_go() -> None:
    store = PlaceStore(capacity=3)
    for number, x in enumerate((0.0, 1.0, 1.3, 5.0)):
        pose = np.eye(4)
        pose[0, 3] = x
        assert store.wants(pose)
        store.add(Place("c", number, pose, np.zeros((1, 3), np.float32), np.zeros((1, 128), np.uint8)))
    assert [p.stamp_ns for p in store.places] == [0, 1, 3]
    near = np.eye(4)
    near[0, 3] = 0.1
    assert not store.wants(near)
    store.move({("c", 0): np.diag([-1.0, -1, 1, 1])})
    assert store.places[0].T_world_camera[0, 0] == -1
