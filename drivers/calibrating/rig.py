"""From gathered views to calibrated cameras and, of those that see the board at once, to where they sit on a rig."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from semantic_mapper.drivers.calibrating.camera import CameraCalibration, calibrate_camera, compare_camera, ideal_pixels
from semantic_mapper.drivers.calibrating.views import BoardView, CalibrationConfig, ViewGatherer, simultaneous
from semantic_mapper.drivers.poses.board import board_poses
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
class Calibration:
    """All that came out, by camera."""

    cameras: dict[str, CameraCalibration]
    rig: dict[str, RigCamera] = field(default_factory=dict[str, RigCamera])  # empty where it was not requested
    rig_rms_px: float = 0.0  # of all corners at once


def solve(
    gathered: Mapping[str, ViewGatherer], known: Collection[str], config: CalibrationConfig, *, rig: bool
) -> Calibration:
    """Calibrate cameras and, with ``rig``, find where they sit on it; the first one is where the rig is.

    The intrinsics of ``known`` cameras are right as their source gives them. Raises CameraError: a result is not as
    ``config`` wants it; says why, and what to do.
    """
    cameras: dict[str, CameraCalibration] = {}
    for name, views in gathered.items():
        if views.size is None or views.intrinsics is None or not views.seen:
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
        return Calibration(cameras)
    instants = simultaneous({name: views.steady for name, views in gathered.items()})
    lenses = {name: camera.intrinsics for name, camera in cameras.items()}
    return Calibration(cameras, *calibrate_rig(lenses, instants, config))


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """What one camera saw at one instant; pixels without distortion."""

    points: Float64
    pixels: Float64
    T_camera_board: Float64


def calibrate_rig(
    cameras: Mapping[str, CameraIntrinsics], instants: Sequence[Mapping[str, BoardView]], config: CalibrationConfig
) -> tuple[dict[str, RigCamera], float]:
    """At least two cameras and all boards fitted at once (bundle adjustment with the intrinsics as they are).

    ``instants`` as of ``views.simultaneous``. Returns the cameras by name, and the RMS error of all corners in pixels.
    Raises CameraError: cameras hardly see the board at once, or views do not fit each other.
    """
    sights: list[dict[str, _Sight]] = []
    for views in instants:
        own: dict[str, _Sight] = {}
        for name, lens in cameras.items():
            pixels = ideal_pixels(views[name].pixels, lens) if name in views else None
            if pixels is not None and (poses := board_poses(views[name].points, pixels, lens)):
                own[name] = _Sight(views[name].points, pixels, poses[0][1])
        if len(own) > 1:
            sights.append(own)
    poses, rms_px, sigmas = _adjust_bundle(cameras, sights, _first_guess(list(cameras), sights))
    if rms_px > config.max_error_px:
        raise CameraError(
            f"the cameras do not agree on where the board is: corners are off by {rms_px:.2f} px (RMS; "
            f"{config.max_error_px:g} are allowed). Hold the board still, and check that stamps are of one clock and "
            "that no camera has moved on the rig"
        )
    rig: dict[str, RigCamera] = {}
    for name, pose, sigma in zip(cameras, poses, sigmas, strict=True):
        turn, position = (float(np.sqrt((part**2).mean())) for part in np.split(sigma, 2))
        if position > MAX_POSITION_SIGMA_M:
            raise CameraError(
                f"camera '{name}': its place on the rig is known to {1000 * position:.1f} mm only (one sigma; "
                f"{1000 * MAX_POSITION_SIGMA_M:g} are needed): show the board nearer to both cameras at once"
            )
        rig[name] = RigCamera(pose, sum(name in own for own in sights), position, float(np.degrees(turn)))
    return rig, rms_px


def _first_guess(names: Sequence[str], sights: Sequence[Mapping[str, _Sight]]) -> dict[str, Float64]:
    """T_rig_camera along the pairs of cameras that see the board together most often; ``CameraError`` without any."""
    known: dict[str, Float64] = {names[0]: np.eye(4)}
    while len(known) < len(names):
        shared = {
            (a, b): [own[a].T_camera_board @ invert_pose(own[b].T_camera_board) for own in sights if {a, b} <= set(own)]
            for a in known
            for b in names
            if b not in known
        }
        (a, b), motions = max(shared.items(), key=lambda item: len(item[1]))
        if len(motions) < MIN_INSTANTS:
            lost = ", ".join(f"'{name}'" for name in names if name not in known)
            raise CameraError(
                f"camera {lost}: saw the board at only {len(motions)} moments together with another camera of the rig; "
                f"{MIN_INSTANTS} are needed: hold it where both see it, still, in several places"
            )
        # The one that is nearest to all others: one that is off does not pull it.
        stack = np.array(motions)
        apart = np.linalg.norm((stack[:, None] - stack[None])[..., :3, :], axis=(-2, -1)).sum(axis=1)
        known[b] = known[a] @ stack[int(apart.argmin())]
    return {name: known[name] for name in names}


def _adjust_bundle(
    cameras: Mapping[str, CameraIntrinsics], sights: Sequence[Mapping[str, _Sight]], guess: Mapping[str, Float64]
) -> tuple[Float64, float, Float64]:
    """Fit the poses of all cameras but the first and of all boards to the corners seen, from a first guess.

    Returns: T_rig_camera by camera, the RMS error in pixels, and one sigma (C, 6) of turn (radians) and position.
    """
    numbers = {name: number for number, name in enumerate(cameras)}
    first = [next(iter(own.items())) for own in sights]
    boards = [guess[name] @ sight.T_camera_board for name, sight in first]
    start = np.array([*guess.values(), *boards])  # (P, 4, 4)
    seen = [(numbers[name], len(cameras) + row, s) for row, own in enumerate(sights) for name, s in own.items()]
    owners = [(camera, board) for camera, board, sight in seen for _ in sight.points]
    camera, board = np.array(owners).T  # (N,) rows of ``start``
    points = np.concatenate([sight.points for *_, sight in seen])
    pixels = np.concatenate([sight.pixels for *_, sight in seen])
    focal, centre = np.array([((k.fx, k.fy), (k.cx, k.cy)) for k in cameras.values()])[camera].transpose(1, 0, 2)

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
    fit: Any = least_squares(
        residuals,
        np.zeros(6 * (len(start) - 1)),
        jac_sparsity=np.kron(touched[:, 1:], np.ones((2, 6), np.uint8)),
        tr_options={"atol": 1e-12, "btol": 1e-12},  # with steps less exact, one wrong view takes thousands of them
        loss="huber",
        f_scale=_HUBER_PX,
        x_scale="jac",
        xtol=1e-10,
    )
    squares = (residuals(fit.x) ** 2).sum()
    hessian = (fit.jac.T @ fit.jac).toarray()  # of the robust cost
    covariance = squares / max(1, pixels.size - len(fit.x)) * np.linalg.inv(hessian)
    free = np.sqrt(np.diag(covariance)).reshape(-1, 6)[: len(cameras) - 1]
    sigmas = np.concatenate((np.zeros((1, 6)), free))
    return poses(fit.x)[: len(cameras)], float(np.sqrt(squares / len(pixels))), sigmas
