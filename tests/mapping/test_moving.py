"""What moves is left out of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import make_pose
from semantic_mapper.labels import KITTI360, ROOMS
from semantic_mapper.mapping.moving import SETTLED_S, MotionDetector, MovingFilter, MovingSpace
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.types import Bool, CameraIntrinsics, Float64, PosedFrame
from tests.mapping.test_voxel_map import same
from tests.small import tiny_config, tiny_pipeline

CAMERA = CameraIntrinsics(130.0, 130.0, 79.5, 59.5, 160, 120)
WALL_M, POLE_M, THING_M = 3.0, 2.2, 1.8
HZ = 10
NOISE_M = 0.02


def scene(number: int, left: int | None, *, shift_m: float = 0.0) -> tuple[PosedFrame, Bool]:
    """A wall, a pole, and before them a thing 30 pixels wide whose left edge is at ``left`` for a camera that is not
    shifted; and where that is."""
    rng = np.random.default_rng(number)
    depth = (WALL_M + rng.normal(0, NOISE_M, (120, 160))).astype(np.float32)
    pole = 40 - round(shift_m * CAMERA.fx / POLE_M)
    depth[:, max(pole, 0) : max(pole + 4, 0)] = POLE_M
    thing = np.zeros((120, 160), np.bool_)
    if left is not None:
        left -= round(shift_m * CAMERA.fx / THING_M)
        thing[20:100, max(left, 0) : max(left + 30, 0)] = True
        depth[thing] = THING_M + rng.normal(0, NOISE_M, int(thing.sum()))
    rgb = np.where(thing[..., None], np.uint8(200), np.uint8(90)) * np.ones(3, np.uint8)
    T = np.eye(4)
    T[0, 3] = shift_m
    return PosedFrame(number * 10**9 // HZ, number, "front", rgb, depth, None, CAMERA, T), thing


def test_what_passes_by_is_found_and_a_still_scene_is_not() -> None:
    detector, inter, union = MotionDetector(6.0), 0, 0
    for number in range(20):
        frame, thing = scene(number, None if number < 3 else -30 + 10 * number, shift_m=0.01 * number)
        found = detector.find(frame)
        if number < 3:
            assert not found.any()
        inter, union = inter + int((found & thing).sum()), union + int((found | thing).sum())
    assert inter / union > 0.8
    detector = MotionDetector(6.0)
    assert not any(detector.find(scene(n, 60, shift_m=0.02 * n)[0]).any() for n in range(20))


def test_what_stays_settles_and_forgetting_leaves_nothing_to_compare_with() -> None:
    detector = MotionDetector(6.0)
    detector.find(scene(0, None)[0])
    found = [bool(detector.find(scene(n, 60)[0]).any()) for n in range(2, int(SETTLED_S * HZ) + 5)]
    assert found[: int(SETTLED_S * HZ) - 2] == [True] * (int(SETTLED_S * HZ) - 2) and not any(found[-3:])
    detector.find(scene(100, None)[0])
    detector.clear()
    assert not detector.find(scene(103, 60)[0]).any()


def test_a_pose_that_jumps_is_no_motion() -> None:
    detector = MotionDetector(6.0)
    detector.find(scene(0, None)[0])
    frame, _ = scene(3, None)
    assert frame.depth_m is not None
    assert not detector.find(replace(frame, depth_m=frame.depth_m - 1)).any() and not detector.poses_fit


def corner(number: int, pose: Float64, thing_m: float | None = None) -> PosedFrame:
    """Two walls and a floor that meet before the camera, and a thing as wide as half of the picture, exact."""
    v, u = np.mgrid[:120, :160]
    rays = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((120, 160))), axis=-1)
    rays, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    depth = np.full((120, 160), np.inf)
    for normal, distance in (((0.6, 0.0, 0.8), 2.6), ((-0.6, 0.0, 0.8), 2.4), ((0.0, 1.0, 0.0), 1.0)):
        with np.errstate(divide="ignore"):
            z = (distance - origin @ np.array(normal)) / (rays @ np.array(normal))
        depth = np.where(z > 0, np.minimum(depth, z), depth)
    if thing_m is not None:
        depth[:, 20:120] = thing_m
    rgb = np.zeros((120, 160, 3), np.uint8)
    return PosedFrame(number * 10**9 // HZ, number, "front", rgb, depth.astype(np.float32), None, CAMERA, pose)


def off_by(sigma_m: float, sigma_deg: float, rng: np.random.Generator) -> Float64:
    return make_pose(rng.normal(0, np.deg2rad(sigma_deg), 3), rng.normal(0, sigma_m, 3))


@pytest.mark.parametrize(("sigma_m", "sigma_deg", "fit"), [(0.02, 0.5, True), (0.1, 3.0, False)])
def test_poses_that_are_off_are_put_right_or_known_to_be_wrong(sigma_m: float, sigma_deg: float, fit: bool) -> None:
    detector, rng, found, fits = MotionDetector(6.0), np.random.default_rng(3), 0, 0
    for number in range(40):
        frame = corner(number, np.eye(4))
        found += int(detector.find(replace(frame, T_world_camera=off_by(sigma_m, sigma_deg, rng))).sum())
        fits += detector.poses_fit
    assert found < 0.01 * 40 * 120 * 160 and (fits == 40 if fit else fits < 10)


def pipeline(**moving: bool) -> MappingPipeline:
    return tiny_pipeline(moving=moving, history={"max_frames": 50}, voxel_map=VOXELS)


VOXELS = {"voxel_size_m": 0.05, "clear_free_space": False}


def wall_of(p: MappingPipeline) -> int:
    """Surface points of the passer-by in the map."""
    return int((np.abs(p.voxel_map.points().xyz[:, 2] - THING_M) < 0.2).sum())


def test_a_passer_by_is_no_wall_neither_when_the_map_is_built_again() -> None:
    on, off = pipeline(motion=True), pipeline(motion=False)
    for number in range(12):
        frame, _ = scene(number, None if number < 3 else -30 + 15 * number, shift_m=0.03 * number)
        update, plain = on.step(frame), off.step(frame)
        assert plain.moving is None and update.moving is not None and frame.depth_m is not None
        assert np.array_equal(update.depth_m[update.moving], frame.depth_m[update.moving]), "to be shown"
    assert abs(np.median(on.moving.space.points[:, 2]) - THING_M) < 0.1 and not len(off.moving.space.points)
    assert wall_of(on) < 0.05 * wall_of(off) and on.moving.pixels > 10_000 and off.moving.pixels == 0
    before = on.voxel_map.block_state()
    on.corrector.start({11 * 10**9 // HZ: on.corrector.place(scene(11, None, shift_m=0.33)[0]).T_world_camera})
    while not on.corrector.advance(4):
        pass
    assert same(on.voxel_map.block_state(), before)


def test_where_it_moved_is_kept_for_a_second() -> None:
    space = MovingSpace()
    for number in range(2 * HZ):
        frame, thing = scene(number, 60 if number < 3 else None)
        space.add(frame, thing)
        assert bool(len(space.points)) == (number <= 2 + HZ)
    frame, thing = scene(50, 60)
    space.add(frame, thing)
    x = space.points[:, 0]
    assert np.abs(space.points[:, 2] - THING_M).max() < 0.2 and -0.3 < x.min() < x.max() < 0.2
    space.add(scene(48, None)[0], np.zeros_like(thing))  # late
    assert len(space.points)
    space.add(scene(1, None)[0], np.zeros_like(thing))  # stamps that go back start over
    assert not len(space.points)


def test_pixels_of_a_class_that_moves_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [scene(number, 60, shift_m=0.03 * number)[0] for number in range(4)]
    off = pipeline(motion=False)
    label = np.concatenate([off.step(f).label.ravel() for f in frames])
    common = int(np.bincount(label[label != ROOMS.ignore_id]).argmax())
    with pytest.raises(ConfigError, match="none of the classes of 'kitti360' moves"):
        MovingFilter(tiny_config(moving={"classes": True}), KITTI360)
    monkeypatch.setattr("semantic_mapper.mapping.moving.MOVING_NAMES", {ROOMS.names[ROOMS.ids.index(common)]})
    on = pipeline(classes=True, motion=False)
    updates = [on.step(f) for f in frames]
    moving = [u.moving for u in updates if u.moving is not None]
    assert len(moving) == 4 and sum(int(m.sum()) for m in moving) == on.moving.pixels > 0
    shown = [
        (u.depth_m[m], f.depth_m[m]) for m, u, f in zip(moving, updates, frames, strict=True) if f.depth_m is not None
    ]
    assert len(shown) == 4 and all(np.array_equal(told, measured) for told, measured in shown)
    assert len(on.voxel_map.points().xyz) < 0.8 * len(off.voxel_map.points().xyz)
