from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.upright import camera_up, ceiling_height, upright_rotation
from semantic_mapper.geometry import look_at
from tests.evaluation.room_points import DEPTH, HEIGHT, WIDTH, room_points

UP = np.array([0.0, 0, 1])


def tilt_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def turned(rotation_deg: tuple[float, float, float]) -> np.ndarray:
    return cv2.Rodrigues(np.deg2rad(np.array(rotation_deg)))[0]


@pytest.mark.parametrize("rotation", [(0, 0, 0), (7, -4, 20), (40, 30, -70), (170, 10, 0)])
def test_a_rough_guess_of_up_is_mended(rotation: tuple[float, float, float]) -> None:
    R_world_room = turned(rotation)
    xyz = room_points(0.06).xyz @ R_world_room.T
    R = upright_rotation(xyz, R_world_room @ turned((5, -4, 0)) @ UP)
    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) > 0
    assert tilt_deg(R[2], R_world_room @ UP) < 1
    np.testing.assert_allclose(np.ptp(xyz @ R.T, axis=0), (WIDTH, DEPTH, HEIGHT), atol=0.12)  # the longer side along x
    room = room_points(0.06).xyz  # a bad guess will do where an axis of the world is up
    assert tilt_deg(upright_rotation(room, turned((35, 0, 0)) @ UP)[2], UP) < 0.5


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_without_a_guess_the_fullest_layer_is_the_floor(up: tuple[float, float, float]) -> None:
    points = room_points(0.06)
    xyz = points.xyz[points.xyz[:, 2] < 2]  # no ceiling: a room with one is the same upside down
    across = np.roll(up, 1)
    R_world_room = np.stack((across, np.cross(up, across), up), axis=1)
    R = upright_rotation(xyz @ R_world_room.T)
    assert tilt_deg(R[2], np.array(up, np.float64)) < 1


def test_few_points_take_the_guess_as_it_is_and_one_without_direction_is_refused() -> None:
    assert np.allclose(upright_rotation(np.zeros((0, 3), np.float32), np.array([0, -2.0, 0]))[2], (0, -1, 0))
    assert np.allclose(upright_rotation(np.zeros((3, 3), np.float32)), np.eye(3))
    for bad in (np.zeros(3), np.full(3, np.nan)):
        with pytest.raises(ShapeError, match="up"):
            upright_rotation(room_points(0.2).xyz, bad)
    with pytest.raises(ShapeError, match="xyz"):
        upright_rotation(np.zeros((5, 2)))


def test_cameras_that_look_down_and_turn_still_tell_up() -> None:
    angles = np.linspace(0, 2, 12)
    poses = np.stack([look_at(np.zeros(3), np.array([np.cos(a), np.sin(a), -0.7]), UP) for a in angles])
    assert tilt_deg(camera_up(poses), UP) < 1e-3
    assert tilt_deg(camera_up(poses[:1]), UP) == pytest.approx(35, abs=1)  # one view alone says no better
    with pytest.raises(ShapeError, match="N > 0"):
        camera_up(poses[:0])


def test_the_ceiling_is_found_and_an_open_room_has_none() -> None:
    xyz = room_points().xyz
    above = xyz[:, 2] > HEIGHT - 0.02
    for seen in (xyz, xyz[~above | (xyz[:, 0] + xyz[:, 1] < 1.6)]):  # all of it, and a tenth
        cut = ceiling_height(seen)
        assert cut is not None and HEIGHT - 0.25 < cut < HEIGHT
    assert ceiling_height(xyz[xyz[:, 2] < HEIGHT - 0.1]) is None
    assert ceiling_height(np.zeros((0, 3))) is None


def test_up_of_a_real_recording_is_that_of_its_annotation(redkitchen: Path) -> None:
    mesh = np.load(redkitchen / "mesh_labels.npz")
    poses = np.loadtxt(redkitchen / "poses.txt").reshape(-1, 4, 4)
    R = upright_rotation(mesh["vertices"], camera_up(poses))
    assert tilt_deg(R[2], mesh["T_gravity"][2, :3]) < 1.5
