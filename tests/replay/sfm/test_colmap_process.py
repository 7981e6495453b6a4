"""Where a reconstruction begins: cameras that go straight ahead, and cameras that only turn; features, no pictures."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from semantic_mapper.geometry import align_similar, look_at, transform
from semantic_mapper.replay.sfm import colmap
from semantic_mapper.replay.sfm.colmap import read_model
from semantic_mapper.replay.sfm.colmap_process import main
from semantic_mapper.types import Float64

W, H, FOCAL, FRAMES = 640, 360, 400.0, 10
UP = np.eye(3)[2]
EYES = np.array([(0.6 * n, 0.0, 1.5) for n in range(FRAMES)])
AHEAD = np.stack([look_at(eye, eye + np.eye(3)[0], UP) for eye in EYES])  # no sway at all
YAWS = np.linspace(0.0, 0.6, FRAMES)
TURN = np.stack([look_at(EYES[0], EYES[0] + (np.cos(yaw), np.sin(yaw), 0.0), UP) for yaw in YAWS])


def street(rng: np.random.Generator) -> Float64:
    """(N, 3) points of houses on both sides, and of a road."""
    x, side = rng.uniform(2, 40, 500), rng.choice([-1.0, 1.0], 500)
    houses = np.column_stack((x, side * rng.uniform(4, 7, 500), rng.uniform(0, 6, 500)))
    return np.concatenate((houses, np.column_stack((x[:150], rng.uniform(-3, 3, 150), np.zeros(150)))))


def reconstruct(folder: Path, poses: Float64, camera: colmap.Camera) -> colmap.Outcome:
    """What the process makes of the features of a street, seen from poses (N, 4, 4)."""
    rng = np.random.default_rng(0)
    points = street(rng)
    descriptors = rng.integers(0, 90, (len(points), 128)).astype(np.float64)
    descriptors = np.round(512 * descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.uint8)
    (folder / colmap.FEATURES).mkdir()
    for n, pose in enumerate(poses):
        seen = transform(np.linalg.inv(pose), points)
        xy = FOCAL * seen[:, :2] / np.maximum(seen[:, 2:], 1e-6) + np.array([W / 2, H / 2]) - 0.5
        xy += 0.3 * rng.standard_normal(xy.shape)
        rows = np.flatnonzero((seen[:, 2] > 1) & (seen[:, 2] < 30) & (abs(xy - (W / 2, H / 2)) < (W / 2, H / 2)).all(1))
        np.savez(
            folder / colmap.FEATURES / f"{n:06d}.npz", xy=xy[rows].astype(np.float32), descriptors=descriptors[rows]
        )
    (folder / colmap.REQUEST).write_bytes(msgspec.json.encode(camera))
    main(folder)
    return msgspec.json.decode((folder / colmap.RESULT).read_bytes(), type=colmap.Outcome)


CALIBRATED = colmap.Camera(W, H, (FOCAL, FOCAL, W / 2, H / 2), (FOCAL,))


def test_a_camera_that_goes_straight_ahead_is_placed(tmp_path: Path) -> None:
    outcome = reconstruct(tmp_path, AHEAD, CALIBRATED)
    usual, ahead = outcome.attempts
    assert not usual.ahead and (not usual.models or usual.models[0].images < FRAMES)
    assert ahead.ahead and ahead.models[0].images == FRAMES
    model = read_model(tmp_path / ahead.models[0].folder)
    found, true = np.stack([image.T_world_camera[:3, 3] for image in model.images]), AHEAD[:, :3, 3]
    T, scale = align_similar(found, true)
    assert np.linalg.norm(transform(T, scale * found) - true, axis=1).max() < 0.03  # of a way of 5.4 m
    assert outcome.focal_sigma is None
    assert colmap.turn_fraction(outcome.pairs) == 0


def test_a_straight_way_does_not_tell_the_focal_length_and_says_so(tmp_path: Path) -> None:
    outcome = reconstruct(tmp_path, AHEAD, colmap.Camera(W, H, None, (1.2 * FOCAL,)))
    best = outcome.best
    assert best.ahead and best.models[0].images == FRAMES
    kept = next(iter(read_model(tmp_path / best.models[0].folder).cameras.values())).fx
    assert outcome.focal_sigma is not None and outcome.focal_sigma > colmap.UNKNOWN_FOCAL
    assert kept == pytest.approx(1.2 * FOCAL)


def test_a_camera_that_only_turns_is_recognised_and_not_begun_straight_ahead(tmp_path: Path) -> None:
    outcome = reconstruct(tmp_path, TURN, CALIBRATED)
    assert colmap.turn_fraction(outcome.pairs) == 1 and not any(a.ahead for a in outcome.attempts)
