"""Poses, depth and intrinsics that contradict each other are found, and what fits raises no warning."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from structlog.testing import capture_logs

from semantic_mapper.config import KeyframeConfig
from semantic_mapper.geometry import invert_pose, make_pose
from semantic_mapper.imaging import resize_depth, working_intrinsics
from semantic_mapper.mapping.keyframes import KeyframeStore
from semantic_mapper.mapping.pipeline import COVERAGE_WIDTH
from semantic_mapper.mapping.pose_check import MAX_CONTRADICTING, MAX_DISAGREEMENT, MIN_KEYFRAMES, PoseCheck
from semantic_mapper.types import PosedFrame
from tests.mapping.test_keyframes import keyframe
from tests.mapping.test_voxel_map import same
from tests.small import tiny_frames, tiny_pipeline

Change = Callable[[PosedFrame], PosedFrame]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
REP_103 = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # T_body_camera


def check(frames: Iterable[PosedFrame], change: Change = lambda frame: frame) -> PoseCheck:
    """What the pipeline does with its keyframes, without encoding them."""
    store, poses = KeyframeStore(KeyframeConfig()), PoseCheck(5.0)
    for frame in map(change, frames):
        if not store.wants(frame.T_world_camera):
            continue
        intrinsics = working_intrinsics(frame.intrinsics, COVERAGE_WIDTH)
        depth = resize_depth(frame, intrinsics)
        new = replace(keyframe(frame.seq, frame.T_world_camera, depth=depth), intrinsics=intrinsics)
        poses.add(new, store.choose(frame.T_world_camera, intrinsics, depth, 7), store.keyframes)
        store.add(new)
    return poses


def room() -> tuple[PosedFrame, ...]:
    return tiny_frames(30, seed=13)


def walk() -> tuple[PosedFrame, ...]:
    """One in which each of these faults shows. In many other rooms some do not: see docs/howto.md."""
    return tiny_frames(60, seed=15)


def posed(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda frame: replace(frame, T_world_camera=change(frame.T_world_camera))


def millimetres(T: np.ndarray) -> np.ndarray:
    return np.block([[T[:3, :3], 1000 * T[:3, 3:]], [T[3:]]])


def deeper(factor: float) -> Change:
    def change(frame: PosedFrame) -> PosedFrame:
        assert frame.depth_m is not None
        return replace(frame, depth_m=frame.depth_m * np.float32(factor))

    return change


WRONG: dict[str, tuple[Change, str]] = {
    "inverted": (posed(invert_pose), "With poses inverted"),
    "OpenGL axes": (posed(lambda T: T @ OPENGL), "With camera axes turned from OpenGL's"),
    "REP 103 axes": (posed(lambda T: T @ np.linalg.inv(REP_103)), "With camera axes turned from a robot's (REP 103"),
    "millimetres": (posed(millimetres), "With translations divided by 1000"),
    "depth five times too large": (deeper(5), "With depth divided by 5"),
    "depth five times too small": (deeper(0.2), "With depth multiplied by 5"),
    "depth halved": (deeper(0.5), "With depth multiplied, or positions divided, by 2"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_contradicts_itself_is_reported_once_with_its_cause(wrong: str) -> None:
    change, cause = WRONG[wrong]
    with capture_logs() as logs:
        poses = check(room(), change)
    assert poses.compared >= MIN_KEYFRAMES and poses.worst is not None and poses.worst > MAX_DISAGREEMENT
    assert cause in poses.warning and "T_world_camera" in poses.warning
    assert [entry["event"] for entry in logs] == ["keyframes_contradict_each_other"]


def test_a_good_recording_is_far_from_a_warning() -> None:
    poses = check(room())
    assert not poses.warning and poses.compared > MIN_KEYFRAMES
    assert poses.worst is not None and poses.worst < MAX_DISAGREEMENT / 2
    assert poses.worst_contradicting == 0


def moved(x: float = 0.0, z: float = 0.0, turned_deg: float = 0.0) -> np.ndarray:
    """How the world is shifted (metres) and turned about its y axis, (4, 4)."""
    return make_pose((0.0, np.radians(turned_deg), 0.0), (x, 0.0, z))


def from_on(fraction: float, T: np.ndarray) -> Change:
    return lambda frame: posed(lambda pose: T @ pose)(frame) if frame.seq >= fraction * 60 else frame


BEGINS_LATE: dict[str, Change] = {
    "second half 20 cm aside": from_on(0.5, moved(x=0.2)),
    "second half 20 cm ahead": from_on(0.5, moved(z=0.2)),
    "second half 50 cm aside": from_on(0.5, moved(x=0.5)),
    "second half turned by 15 degrees": from_on(0.5, moved(turned_deg=15)),
    "second half turned by 5 degrees": from_on(0.5, moved(turned_deg=5)),
    "last fifth 30 cm aside": from_on(0.8, moved(x=0.3)),
    "every other ten frames 20 cm aside": lambda f: posed(lambda T: moved(x=0.2 * (f.seq // 10 % 2)) @ T)(f),
    "drift of 50 cm": lambda f: posed(lambda T: moved(x=0.5 * f.seq / 60) @ T)(f),
    "depth 1.5 times too large": deeper(1.5),
    "depth a third too small": deeper(0.67),
}


@pytest.mark.parametrize("wrong", BEGINS_LATE)
def test_what_begins_in_mid_recording_is_reported(wrong: str) -> None:
    poses = check(walk(), BEGINS_LATE[wrong])
    assert poses.worst_contradicting is not None and poses.worst_contradicting > MAX_CONTRADICTING
    assert "sees through" in poses.warning or "disagrees" in poses.warning


def test_what_moves_in_a_third_of_the_picture_raises_no_warning() -> None:
    rng = np.random.default_rng(0)

    def passer_by(frame: PosedFrame) -> PosedFrame:
        assert frame.depth_m is not None
        depth, width = frame.depth_m.copy(), frame.intrinsics.width
        left = int(rng.integers(0, width - width // 3))
        depth[:, left : left + width // 3] = rng.uniform(0.5, 1.0)
        return replace(frame, depth_m=depth)

    poses = check(room(), passer_by)
    assert poses.compared > MIN_KEYFRAMES and not poses.warning


def test_poses_that_stand_still_while_pictures_do_not_are_reported_once_without_depth_too() -> None:
    poses = PoseCheck(5.0)
    with capture_logs() as logs:
        for frame in room():
            poses.look(replace(frame, T_world_camera=np.eye(4), depth_m=None))
    assert "poses stand still" in poses.warning
    assert [entry["event"] for entry in logs] == ["poses_stand_still"]


@pytest.mark.parametrize("passes", ["nothing", "somebody near", "a light"])
def test_a_camera_that_stands_still_raises_no_warning(passes: str) -> None:
    rng, poses, (still, *others) = np.random.default_rng(0), PoseCheck(5.0), room()
    width = still.intrinsics.width
    for number in range(120):
        rgb = still.rgb.astype(np.float64)
        if passes == "somebody near" and number % 10:  # in two thirds of the picture, another one each time
            rgb[:, width // 3 :] = others[number % len(others)].rgb[:, width // 3 :]
        if passes == "a light":
            rgb *= 1 - 0.5 * (number // 7 % 2)
        noisy = np.clip(rgb + rng.normal(0, 5, rgb.shape), 0, 255).astype(np.uint8)
        poses.look(replace(still, rgb=noisy))
    assert not poses.warning


def test_the_pipeline_checks_poses_and_the_map_stays_the_same() -> None:
    checked, unchecked = tiny_pipeline(), tiny_pipeline()
    unchecked.pose_check.add = lambda *_: None  # type: ignore[method-assign]
    unchecked.pose_check.look = lambda *_: None  # type: ignore[method-assign]
    for frame in room():
        wrong = replace(frame, T_world_camera=invert_pose(frame.T_world_camera))
        checked.step(wrong)
        unchecked.step(wrong)
    assert "poses inverted" in checked.pose_check.warning and not unchecked.pose_check.warning
    assert same(checked.voxel_map.block_state(), unchecked.voxel_map.block_state())
