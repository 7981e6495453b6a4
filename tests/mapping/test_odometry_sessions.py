from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace as with_settings

from research.scenes import TRAIN_SEEDS, CameraPathConfig, NoiseConfig, room_frames
from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import MapError
from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.correction import ALWAYS
from semantic_mapper.mapping.map_alignment import find_alignment
from semantic_mapper.mapping.odometry_sessions import HELD, OdometrySessions
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.session import MapSession, Refusal
from semantic_mapper.types import CameraIntrinsics, Float64, MapUpdate, PosedFrame

INTRINSICS = CameraIntrinsics(140.0, 140.0, 79.5, 59.5, 160, 120)
SETTINGS = with_settings(MapperConfig(), voxel_map=with_settings(MapperConfig().voxel_map, voxel_size_m=0.04))


@cache
def walk(seed: int = TRAIN_SEEDS[7], count: int = 16) -> tuple[PosedFrame, ...]:
    """Sixteen frames of 160x120 through a furnished room."""
    path = CameraPathConfig(step_m=0.06)
    return tuple(room_frames(seed, count, INTRINSICS, path=path, noise=NoiseConfig()))


def other_world() -> Float64:
    """T_other_map."""
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = 5.0, -3.0, 0.7
    return T


def abroad(frame: PosedFrame, world: int = 7) -> PosedFrame:
    """The frame as a camera gives it that has begun elsewhere."""
    return replace(frame, T_world_camera=other_world() @ frame.T_world_camera, world=world)


def mirrored(frame: PosedFrame) -> PosedFrame:
    assert frame.depth_m is not None
    flipped = np.ascontiguousarray(frame.depth_m[:, ::-1])
    return replace(frame, rgb=np.ascontiguousarray(frame.rgb[:, ::-1]), depth_m=flipped)


def off(T: Float64, truth: Float64) -> tuple[float, float]:
    """Metres and degrees."""
    apart = invert_pose(truth) @ T
    return float(np.linalg.norm(apart[:3, 3])), float(np.rad2deg(np.linalg.norm(rotation_vector(apart))))


@cache
def even() -> MappingPipeline:
    """Has mapped every other frame; for those that change nothing."""
    session = MapSession(Mapper.load(None, SETTINGS), stream_labels=None)
    for frame in walk()[::2]:
        session.process(frame)
    return session.pipeline


def test_a_camera_that_comes_back_in_another_world_goes_on_in_the_map() -> None:
    mapper = Mapper.load(None, SETTINGS)
    session = MapSession(mapper, stream_labels=None)
    for frame in walk()[:12:2]:
        assert session.process(replace(frame, world=3))
    held = 0
    for frame in walk()[1:12:2]:
        results = session.process(abroad(frame))
        last = session.pipeline.last_pose
        assert last is not None and last.stamp_ns == frame.stamp_ns
        if not results:
            held += 1
            assert session.odometry_sessions.held == held and "held until" in session.odometry_sessions.warning
            assert last.T_map_camera is None and last.reason
        else:
            assert last.T_map_camera is not None and off(last.T_map_camera, frame.T_world_camera)[0] < 0.05
            told = results[-1]
            assert isinstance(told, MapUpdate) and told.world == 7
            np.testing.assert_allclose(told.T_map_world @ abroad(frame).T_world_camera, last.T_map_camera, atol=1e-9)
    assert held >= 2 and session.odometry_sessions.found == 1 and not session.odometry_sessions.held
    moved, turned = off(session.odometry_sessions.known[7], invert_pose(other_world()))
    assert moved < 0.1 and turned < 1.0  # where the map's origin lies, metres away
    assert session.fused == 12 and not len(session.refusals.first)


def test_the_same_room_mirrored_and_another_room_are_refused_with_the_reason() -> None:
    for frames in ([mirrored(f) for f in walk()[1::5]], list(walk(TRAIN_SEEDS[19], 8)[1::3])):
        sessions = OdometrySessions(even(), own_first=False)
        for frame in frames:
            taken = sessions.take(abroad(frame))
            assert not taken.ready
        assert sessions.found == 0 and sessions.refused.total() == len(frames)
        given_up = sessions.take_rest().given_up
        assert len(given_up) == len(frames) and all("its place in the map is not known" in why for _, why in given_up)


def test_frames_that_wait_are_bounded_and_the_oldest_are_given_up() -> None:
    sessions = OdometrySessions(Mapper.load(None, SETTINGS).pipeline, own_first=False)
    given_up = [f for n in range(HELD + 5) for f, _ in sessions.take(replace(abroad(walk()[0]), seq=n)).given_up]
    assert [f.seq for f in given_up] == [0, 1, 2, 3, 4] and sessions.held == HELD
    assert sessions.refused["no-places"] == HELD + 5


def test_classes_that_are_not_the_maps_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    last = even().label_set.ids[-1]
    monkeypatch.setattr(even(), "classify", lambda frame: np.full((30, 40), last, np.uint8))
    sessions = OdometrySessions(even(), own_first=False)
    for frame in walk()[1:8:2]:
        assert not sessions.take(abroad(frame)).ready
    assert sessions.refused["classes"] >= 3


def test_frames_are_found_where_a_correction_has_moved_the_map() -> None:
    settings = with_settings(SETTINGS, history=with_settings(SETTINGS.history, max_frames=50))
    session = MapSession(Mapper.load(None, settings), stream_labels=None)
    for frame in walk()[:10:2]:
        session.process(frame)
    shift = np.eye(4)
    shift[:3, 3] = 0.0, 0.5, 0.0
    poses = {f.stamp_ns: shift @ f.T_world_camera for f in walk()[:10:2]}
    session.pipeline.corrector.start(poses, until_ns=ALWAYS)
    assert not session.process(abroad(walk()[1])), "the map is about to move"
    assert session.odometry_sessions.reason == "the map is being corrected"
    while session.pipeline.corrector.advance(8):
        pass
    results: list[MapUpdate | Refusal] = []
    for frame in walk()[3:10:2]:
        results += session.process(abroad(frame))
    last = session.pipeline.last_pose
    assert results and last is not None and last.T_map_camera is not None
    assert off(last.T_map_camera, shift @ walk()[9].T_world_camera)[0] < 0.05


def test_two_maps_of_a_room_find_each_other_and_others_do_not() -> None:
    session = MapSession(Mapper.load(None, SETTINGS), stream_labels=None)
    for frame in walk()[1::2]:
        session.process(abroad(frame))
    found = find_alignment(even().voxel_map, session.pipeline.voxel_map)
    with pytest.raises(MapError, match="would count twice"):
        even().voxel_map.merged(even().voxel_map, np.eye(4))
    moved, turned = off(found.T_map_other @ other_world(), np.eye(4))
    assert found.agreeing >= 3 and moved < 0.004 and turned < 0.1  # single views leave 5 to 12 mm
    elsewhere = MapSession(Mapper.load(None, SETTINGS), stream_labels=None)
    for frame in walk(TRAIN_SEEDS[19], 8)[::3]:
        elsewhere.process(frame)
    with pytest.raises(MapError, match=r"of the second \d+ were found"):
        find_alignment(even().voxel_map, elsewhere.pipeline.voxel_map)
    with pytest.raises(MapError, match="nothing to find itself by"):
        find_alignment(even().voxel_map, VoxelMap(SETTINGS.voxel_map, even().voxel_map.label_set))
