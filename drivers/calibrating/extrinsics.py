"""Where the cameras of a rig sit relative to each other, from a board that several see at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.intrinsics import ideal_pixels
from semantic_mapper.drivers.calibrating.views import BoardView
from semantic_mapper.drivers.poses.board import board_poses, pose_of_vector
from semantic_mapper.errors import CameraError
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.types import CameraIntrinsics, Float64

_HUBER_PX = 1.0  # residuals beyond count less
_ROUNDS = 30
_SETTLED = 1e-9  # a step shorter than this (metres, radians) is the last one


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """A calibrated rig.

    Args:
        T_rig_camera: (4, 4) by camera; the rig is where the first one sits.
        rms_px: Of all corners at once.
        instants: By camera: at how many it saw the board together with another one.
        position_sigma_m, turn_sigma_deg: One-sigma uncertainty by camera; 0 of the first.
    """

    T_rig_camera: dict[str, Float64]
    rms_px: float
    instants: dict[str, int]
    position_sigma_m: dict[str, float]
    turn_sigma_deg: dict[str, float]


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
    """All cameras and all boards fitted at once (bundle adjustment with the intrinsics as they are).

    Args:
        cameras: At least two.
        instants: See ``views.simultaneous``.
        config: What a result has to be like.

    Raises:
        CameraError: cameras that hardly see the board at once, or views that do not fit each other.
    """
    names = list(cameras)
    lenses = [cameras[name] for name in names]
    sights = _sights(names, lenses, instants)
    T_rig_camera = _first_guess(names, sights, config)
    boards = {s.instant: T_rig_camera[s.camera] @ s.T_camera_board for s in reversed(sights)}
    bundle = _Bundle(lenses, sights, T_rig_camera, boards)
    bundle.settle()
    rms_px = bundle.rms_px()
    if rms_px > config.max_error_px:
        raise CameraError(
            f"the cameras do not agree on where the board is: corners are off by {rms_px:.2f} px (RMS; "
            f"{config.max_error_px:g} are allowed). Hold the board still, and check that stamps are of one clock and "
            "that no camera has moved on the rig"
        )
    sigmas = bundle.camera_sigmas()
    positions = {name: float(np.sqrt((sigmas[i, 3:] ** 2).sum() / 3)) for i, name in enumerate(names)}
    for name, sigma in positions.items():
        if sigma > config.max_position_sigma_m:
            raise CameraError(
                f"camera '{name}': its place on the rig is known to {1000 * sigma:.1f} mm only (one sigma; "
                f"{1000 * config.max_position_sigma_m:g} are needed): show the board nearer to both cameras at once"
            )
    return RigCalibration(
        dict(zip(names, bundle.cameras, strict=True)),
        rms_px,
        {name: sum(s.camera == i for s in sights) for i, name in enumerate(names)},
        positions,
        {name: float(np.degrees(np.sqrt((sigmas[i, :3] ** 2).sum() / 3))) for i, name in enumerate(names)},
    )


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


def _first_guess(names: Sequence[str], sights: Sequence[_Sight], config: CalibrationConfig) -> list[Float64]:
    """T_rig_camera along the pairs of cameras that see the board together most often.

    Raises:
        CameraError: a camera that is in no pair that leads to the first one.
    """
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
        if len(pairs) < config.min_instants:
            lost = ", ".join(f"'{name}'" for i, name in enumerate(names) if i not in known)
            raise CameraError(
                f"camera {lost}: saw the board at only {len(pairs)} moments together with another camera of the rig; "
                f"{config.min_instants} are needed: hold it where both see it, still, in several places"
            )
        known[b] = known[a] @ _middle([p.T_camera_board @ invert_pose(q.T_camera_board) for p, q in pairs])
    return [known[i] for i in range(len(names))]


def _middle(poses: Sequence[Float64]) -> Float64:
    """The pose that is nearest to all others: one that is off does not pull it."""
    stack = np.array(poses)
    apart = np.linalg.norm((stack[:, None] - stack[None])[..., :3, :], axis=(-2, -1)).sum(axis=1)
    return stack[int(apart.argmin())]


class _Bundle:
    """Gauss-Newton over the poses of cameras (but the first) and boards; small turns and shifts are right-hand."""

    def __init__(
        self,
        lenses: Sequence[CameraIntrinsics],
        sights: Sequence[_Sight],
        cameras: Sequence[Float64],
        boards: Mapping[int, Float64],
    ) -> None:
        self._lenses = lenses
        self._sights = sights
        self._rows = {instant: row for row, instant in enumerate(boards)}
        self.cameras = list(cameras)
        self._boards = [boards[instant] for instant in boards]
        self._hessian: Float64 = np.zeros((0, 0))

    def settle(self) -> None:
        """Fit until it moves no more."""
        damping = 1e-6
        cost = self._cost()
        for _ in range(_ROUNDS):
            hessian, gradient = self._normal_equations()
            damped = hessian + damping * np.diag(np.diag(hessian))
            step: Float64 = -np.linalg.solve(damped, gradient).astype(np.float64)
            before = list(self.cameras), list(self._boards)
            self._move(step)
            new_cost = self._cost()
            if new_cost > cost:
                self.cameras, self._boards = before
                damping *= 10
                continue
            cost, damping = new_cost, damping / 3
            if np.abs(step).max() < _SETTLED:
                break
        self._hessian = self._normal_equations()[0]

    def rms_px(self) -> float:
        """Root mean square of the distances of corners, seen and predicted."""
        squares = [(self._residual(s)[0] ** 2).sum(axis=1) for s in self._sights]
        return float(np.sqrt(np.concatenate(squares).mean()))

    def camera_sigmas(self) -> Float64:
        """(C, 6) one sigma of turn (radians) and position (metres), from how well the corners fit."""
        corners = sum(len(s.points) for s in self._sights)
        free = max(1, 2 * corners - len(self._hessian))
        variance = self.rms_px() ** 2 * corners / free
        covariance = variance * np.linalg.inv(self._hessian)
        own = np.sqrt(np.diag(covariance))[: 6 * (len(self.cameras) - 1)].reshape(-1, 6)
        return np.concatenate((np.zeros((1, 6)), own))

    def _move(self, step: Float64) -> None:
        parts = step.reshape(-1, 6)
        count = len(self.cameras) - 1
        self.cameras[1:] = [T @ pose_of_vector(part) for T, part in zip(self.cameras[1:], parts[:count], strict=True)]
        self._boards = [T @ pose_of_vector(part) for T, part in zip(self._boards, parts[count:], strict=True)]

    def _cost(self) -> float:
        total = 0.0
        for sight in self._sights:
            far = np.linalg.norm(self._residual(sight)[0], axis=1)
            total += float(np.where(far < _HUBER_PX, far**2, 2 * _HUBER_PX * far - _HUBER_PX**2).sum())
        return total

    def _residual(self, sight: _Sight) -> tuple[Float64, Float64, Float64]:
        """Predicted minus seen (N, 2), the points in the camera (N, 3), and T_camera_board."""
        T = invert_pose(self.cameras[sight.camera]) @ self._boards[self._rows[sight.instant]]
        lens = self._lenses[sight.camera]
        at = transform(T, sight.points)
        z = np.maximum(at[:, 2], 1e-6)
        seen = np.stack((lens.fx * at[:, 0] / z + lens.cx, lens.fy * at[:, 1] / z + lens.cy), axis=1)
        return seen - sight.pixels, at, T

    def _normal_equations(self) -> tuple[Float64, Float64]:
        count = 6 * (len(self.cameras) - 1 + len(self._boards))
        hessian, gradient = np.zeros((count, count)), np.zeros(count)
        for sight in self._sights:
            off, at, T = self._residual(sight)
            by_point = _projection_slope(at, self._lenses[sight.camera])
            by_camera = by_point @ np.concatenate((_cross(at), np.broadcast_to(-np.eye(3), (len(at), 3, 3))), axis=2)
            by_board = (by_point @ T[:3, :3]) @ np.concatenate(
                (-_cross(sight.points), np.broadcast_to(np.eye(3), (len(at), 3, 3))), axis=2
            )
            board = 6 * (len(self.cameras) - 1 + self._rows[sight.instant])
            columns = list(range(board, board + 6))
            slope = by_board
            if sight.camera:
                columns = [*range(6 * (sight.camera - 1), 6 * sight.camera), *columns]
                slope = np.concatenate((by_camera, by_board), axis=2)
            weight = np.minimum(1.0, _HUBER_PX / np.maximum(np.linalg.norm(off, axis=1), 1e-12))
            flat, rest = slope.reshape(-1, len(columns)), off.ravel()
            heavy = flat * np.repeat(weight, 2)[:, None]
            hessian[np.ix_(columns, columns)] += heavy.T @ flat
            gradient[columns] += heavy.T @ rest
        return hessian, gradient


def _projection_slope(at: Float64, lens: CameraIntrinsics) -> Float64:
    """(N, 2, 3): pixels by a point in the camera."""
    x, y, z = at[:, 0], at[:, 1], np.maximum(at[:, 2], 1e-6)
    zero = np.zeros_like(z)
    u = np.stack((lens.fx / z, zero, -lens.fx * x / z**2), axis=1)
    v = np.stack((zero, lens.fy / z, -lens.fy * y / z**2), axis=1)
    return np.stack((u, v), axis=1)


def _cross(points: Float64) -> Float64:
    """(N, 3, 3) with ``cross(p) @ v = p x v``."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
