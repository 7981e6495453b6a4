"""From gathered views to calibrated cameras and, of those that see the board at once, to where they sit on a rig."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from semantic_mapper.drivers.calibrating.camera import CameraCalibration, calibrate_camera, compare_camera, ideal_pixels
from semantic_mapper.drivers.calibrating.views import BoardView, CalibrationConfig, ViewGatherer, simultaneous
from semantic_mapper.drivers.poses.board import board_poses, pose_of_vector
from semantic_mapper.errors import CameraError
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import CameraIntrinsics, Float64

MIN_INSTANTS = 8  # at which two cameras see the board at once
MAX_POSITION_SIGMA_M = 0.003  # one sigma of a camera's place on the rig
_HUBER_PX = 1.0  # residuals beyond count less


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """Where a camera sits on the rig."""

    T_rig_camera: Float64  # (4, 4); the rig is where its first camera sits
    moments: int  # at how many it saw the board together with another one
    # One-sigma uncertainty; 0 of the first camera.
    position_sigma_m: float
    turn_sigma_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """A calibrated rig."""

    cameras: dict[str, RigCamera]
    rms_px: float  # of all corners at once


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """All that came out."""

    cameras: dict[str, CameraCalibration]  # by name
    rig: RigCalibration | None  # None where it was not requested


def solve(
    gathered: Mapping[str, ViewGatherer], known: Collection[str], config: CalibrationConfig, *, rig: bool
) -> Calibration:
    """Calibrate cameras, the first one of which is where the rig is; ``rig``: also find where they sit on it.

    Args:
        gathered: By camera.
        known: Cameras whose intrinsics are right as their source gives them.
        config: What a result has to be like; ``CameraError`` says why one is not, and what to do.
        rig: See above.
    """
    cameras: dict[str, CameraCalibration] = {}
    for name, views in gathered.items():
        if views.size is None or views.intrinsics is None:
            raise CameraError(f"camera '{name}': gave no image")
        if not views.seen:
            raise CameraError(
                f"camera '{name}': the board was found in none of {views.images} images; are its columns, rows, "
                "dictionary and pattern those of the settings (`calibrate --board FILE.png` draws the board that is "
                "looked for)?"
            )
        if name in known:
            cameras[name] = compare_camera(name, views.kept or views.steady, views.intrinsics, config)
        else:
            cameras[name] = calibrate_camera(name, views.kept, views.size, config)
    if not rig:
        return Calibration(cameras, None)
    instants = simultaneous({name: views.steady for name, views in gathered.items()})
    found = calibrate_rig({name: camera.intrinsics for name, camera in cameras.items()}, instants, config)
    return Calibration(cameras, found)


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """What one camera saw at one instant; pixels without distortion."""

    camera: int
    instant: int
    points: Float64
    pixels: Float64
    T_camera_board: Float64


def calibrate_rig(
    cameras: Mapping[str, CameraIntrinsics], instants: Sequence[Mapping[str, BoardView]], config: CalibrationConfig
) -> RigCalibration:
    """At least two cameras and all boards fitted at once (bundle adjustment with the intrinsics as they are).

    ``instants`` as of ``views.simultaneous``. ``CameraError``: cameras that hardly see the board at once, or views
    that do not fit each other.
    """
    names, lenses = list(cameras), list(cameras.values())
    sights = _sights(names, lenses, instants)
    guess = _first_guess(names, sights)
    boards = {s.instant: guess[s.camera] @ s.T_camera_board for s in reversed(sights)}
    poses, rms_px, sigmas = _adjust_bundle(lenses, sights, guess, boards)
    if rms_px > config.max_error_px:
        raise CameraError(
            f"the cameras do not agree on where the board is: corners are off by {rms_px:.2f} px (RMS; "
            f"{config.max_error_px:g} are allowed). Hold the board still, and check that stamps are of one clock and "
            "that no camera has moved on the rig"
        )
    found: dict[str, RigCamera] = {}
    for number, (name, pose) in enumerate(zip(names, poses, strict=True)):
        turn, position = (float(np.sqrt((part**2).mean())) for part in np.split(sigmas[number], 2))
        if position > MAX_POSITION_SIGMA_M:
            raise CameraError(
                f"camera '{name}': its place on the rig is known to {1000 * position:.1f} mm only (one sigma; "
                f"{1000 * MAX_POSITION_SIGMA_M:g} are needed): show the board nearer to both cameras at once"
            )
        moments = sum(sight.camera == number for sight in sights)
        found[name] = RigCamera(pose, moments, position, float(np.degrees(turn)))
    return RigCalibration(found, rms_px)


def _sights(
    names: Sequence[str], lenses: Sequence[CameraIntrinsics], instants: Sequence[Mapping[str, BoardView]]
) -> list[_Sight]:
    found: list[_Sight] = []
    for number, views in enumerate(instants):
        own: list[_Sight] = []
        for camera, (name, lens) in enumerate(zip(names, lenses, strict=True)):
            if name in views:
                pixels = ideal_pixels(views[name].pixels, lens)
                poses = board_poses(views[name].points, pixels, lens)
                if poses:
                    own.append(_Sight(camera, number, views[name].points, pixels, pose_of_vector(poses[0][1])))
        found += own if len(own) > 1 else []
    return found


def _first_guess(names: Sequence[str], sights: Sequence[_Sight]) -> list[Float64]:
    """T_rig_camera along the pairs of cameras that see the board together most often; ``CameraError`` without any."""
    by_instant: dict[int, dict[int, _Sight]] = {}
    for sight in sights:
        by_instant.setdefault(sight.instant, {})[sight.camera] = sight
    known: dict[int, Float64] = {0: np.eye(4)}
    while len(known) < len(names):
        shared = {
            (a, b): [(s[a], s[b]) for s in by_instant.values() if a in s and b in s]
            for a in known
            for b in range(len(names))
            if b not in known
        }
        (a, b), pairs = max(shared.items(), key=lambda item: len(item[1]))
        if len(pairs) < MIN_INSTANTS:
            lost = ", ".join(f"'{name}'" for i, name in enumerate(names) if i not in known)
            raise CameraError(
                f"camera {lost}: saw the board at only {len(pairs)} moments together with another camera of the rig; "
                f"{MIN_INSTANTS} are needed: hold it where both see it, still, in several places"
            )
        known[b] = known[a] @ _middle([p.T_camera_board @ invert_pose(q.T_camera_board) for p, q in pairs])
    return [known[i] for i in range(len(names))]


def _middle(poses: Sequence[Float64]) -> Float64:
    """The pose that is nearest to all others: one that is off does not pull it."""
    stack = np.array(poses)
    apart = np.linalg.norm((stack[:, None] - stack[None])[..., :3, :], axis=(-2, -1)).sum(axis=1)
    return stack[int(apart.argmin())]


def _adjust_bundle(
    lenses: Sequence[CameraIntrinsics],
    sights: Sequence[_Sight],
    cameras: Sequence[Float64],
    boards: Mapping[int, Float64],
) -> tuple[Float64, float, Float64]:
    """Fit the poses of all cameras but the first and of all boards to the corners seen, from a first guess.

    Returns: T_rig_camera by camera, the RMS error in pixels, and one sigma (C, 6) of turn (radians) and position.
    """
    rows = {instant: len(cameras) + row for row, instant in enumerate(boards)}
    start = np.array([*cameras, *boards.values()])  # (P, 4, 4)
    counts = [len(sight.points) for sight in sights]
    camera = np.repeat([sight.camera for sight in sights], counts)  # (N,)
    board = np.repeat([rows[sight.instant] for sight in sights], counts)
    points = np.concatenate([sight.points for sight in sights])
    pixels = np.concatenate([sight.pixels for sight in sights])
    focal = np.array([(lens.fx, lens.fy) for lens in lenses])[camera]
    centre = np.array([(lens.cx, lens.cy) for lens in lenses])[camera]

    def poses(x: Float64) -> Float64:
        """(P, 4, 4); each but the first is moved by a rotation vector and a shift in its own axes."""
        steps = np.tile(np.eye(4), (len(start), 1, 1))
        steps[1:, :3, :3] = Rotation.from_rotvec(x.reshape(-1, 6)[:, :3]).as_matrix()
        steps[1:, :3, 3] = x.reshape(-1, 6)[:, 3:]
        return start @ steps

    def residuals(x: Float64) -> Float64:
        """Predicted minus seen, (2 N,) pixels."""
        T = poses(x)
        T_camera_board = invert_pose(T)[camera] @ T[board]
        p = np.einsum("nij,nj->ni", T_camera_board[:, :3, :3], points) + T_camera_board[:, :3, 3]
        return (focal * p[:, :2] / np.maximum(p[:, 2:], 1e-6) + centre - pixels).ravel()

    # A corner depends on one camera and one board: with the pattern known, few differences give all derivatives.
    touched = np.zeros((len(points), len(start)), np.uint8)
    touched[np.arange(len(points)), camera] = touched[np.arange(len(points)), board] = 1
    sparsity = np.kron(touched[:, 1:], np.ones((2, 6), np.uint8))
    guess = np.zeros(6 * (len(start) - 1))
    fit: Any = least_squares(
        residuals,
        guess,
        jac_sparsity=sparsity,
        tr_options={"atol": 1e-12, "btol": 1e-12},  # with steps less exact, one wrong view takes thousands of them
        loss="huber",
        f_scale=_HUBER_PX,
        x_scale="jac",
        xtol=1e-10,
    )
    squares = (residuals(fit.x) ** 2).sum()
    hessian = (fit.jac.T @ fit.jac).toarray()  # of the robust cost
    covariance = squares / max(1, len(pixels) * 2 - len(guess)) * np.linalg.inv(hessian)
    free = np.sqrt(np.diag(covariance)).reshape(-1, 6)[: len(cameras) - 1]
    sigmas = np.concatenate((np.zeros((1, 6)), free))
    return poses(fit.x)[: len(cameras)], float(np.sqrt(squares / len(pixels))), sigmas
