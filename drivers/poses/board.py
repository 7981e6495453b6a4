"""The camera's pose from a printed board that it sees: ChArUco, or a grid of AprilTags."""

from __future__ import annotations

from collections import Counter
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from semantic_mapper.drivers.base import CameraImage, PoseEstimate
from semantic_mapper.drivers.poses.config import BoardPoses, matrix
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import camera_matrix, invert_pose
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

MIN_CORNER_SIGMA_PX = 0.2  # corners are found no better than this, however well a few of them happen to fit


def make_board(config: BoardPoses) -> Any:
    """The cv2.aruco board that a config tells of; ``generateImage`` of it is what to print.

    Raises:
        ConfigError: OpenCV has no such dictionary, or it holds too few markers.
    """
    name = config.dictionary or ("DICT_5X5_100" if config.pattern == "charuco" else "DICT_APRILTAG_36h11")
    known = {n: v for n, v in vars(cv2.aruco).items() if n.startswith("DICT_")}
    if name not in known:
        raise ConfigError(f"dictionary: OpenCV has no '{name}'; it has {', '.join(sorted(known))}")
    dictionary: Any = cv2.aruco.getPredefinedDictionary(known[name])
    size = (config.columns, config.rows)
    needed = config.columns * config.rows // (2 if config.pattern == "charuco" else 1)
    if needed > len(dictionary.bytesList):
        raise ConfigError(f"dictionary: {name} has {len(dictionary.bytesList)} markers, the board needs {needed}")
    if config.pattern == "charuco":
        board: Any = cv2.aruco.CharucoBoard(size, config.square_m, config.marker_m, dictionary)
        board.setLegacyPattern(config.legacy)
        return board
    gap_m = config.square_m - config.marker_m if config.columns * config.rows > 1 else config.marker_m
    return cv2.aruco.GridBoard(size, config.marker_m, gap_m, dictionary)


class BoardFinder:
    """Finds the corners of a board in images; also where calibration looks for them.

    Args:
        config: The board.

    Raises:
        ConfigError: a board that cannot be.
    """

    def __init__(self, config: BoardPoses) -> None:
        self._board = make_board(config)
        self._charuco = config.pattern == "charuco"
        parameters: Any = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        if self._charuco:
            charuco: Any = cv2.aruco.CharucoParameters()
            self._detector: Any = cv2.aruco.CharucoDetector(self._board, charuco, parameters)
        else:
            self._detector = cv2.aruco.ArucoDetector(self._board.getDictionary(), parameters)

    def find(self, rgb: UInt8) -> tuple[Float64, Float64]:
        """Corners that are seen: on the board (N, 3) in metres, in the image (N, 2) in pixels."""
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self._charuco:
            corners, ids, _, _ = self._detector.detectBoard(gray)
        else:
            corners, ids, _ = self._detector.detectMarkers(gray)
        if ids is None or not len(ids):
            return np.zeros((0, 3)), np.zeros((0, 2))
        points, pixels = self._board.matchImagePoints(corners, ids)
        if points is None or not len(points):
            return np.zeros((0, 3)), np.zeros((0, 2))  # markers of other boards
        return np.asarray(points, np.float64).reshape(-1, 3), np.asarray(pixels, np.float64).reshape(-1, 2)


class BoardPoseSource:
    """Finds the board in every image.

    Args:
        config: The board, where it is, and what a pose must be like to be used.

    Attributes:
        counters: Images without a pose: "no_board" (too few corners seen), "inexact" (reprojection error), "ambiguous"
            (the mirrored pose fits nearly as well), "uncertain" (the corners leave the position open:
            the board is too small in the image).

    Raises:
        ConfigError: a board that cannot be.
    """

    def __init__(self, config: BoardPoses) -> None:
        self._config = config
        self._finder = BoardFinder(config)
        self._T_world_board = matrix(config.T_world_board)
        self._warnings: tuple[str, ...] = ()
        self.counters: Counter[str] = Counter()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the last image had no pose."""
        return self._warnings

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of a rectified image; None where the board is not seen well enough, see ``counters``."""
        points, pixels = self._finder.find(image.rgb)
        if len(points) < self._config.min_corners:
            return self._refuse("no_board", f"{len(points)} corners of it are seen, {self._config.min_corners} needed")
        solutions = board_poses(points, pixels, image.intrinsics)
        if not solutions:
            return self._refuse("no_board", "its corners allow no pose")
        (error_px, pose), others = solutions[0], solutions[1:]
        if error_px > self._config.max_error_px:
            return self._refuse(
                "inexact", f"its corners are off by {error_px:.1f} px; check its sizes and the camera's"
            )
        if others and others[0][0] < self._config.min_flip_ratio * max(error_px, MIN_CORNER_SIGMA_PX):
            return self._refuse("ambiguous", "its mirrored pose fits as well; show it larger, or from the side")
        sigma = _position_sigma(points, pose, image.intrinsics, max(error_px, MIN_CORNER_SIGMA_PX))
        if sigma > self._config.max_sigma_m:
            return self._refuse("uncertain", f"it tells the camera's place to {sigma:.2f} m only; show it larger")
        self._warnings = ()
        return PoseEstimate(self._T_world_board @ invert_pose(pose_of_vector(pose)), "board", sigma)

    def _refuse(self, reason: str, detail: str) -> None:
        self.counters[reason] += 1
        self._warnings = (f"the board gives no pose: {detail}",)


def board_poses(points: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> list[tuple[float, Float64]]:
    """Poses (6,) of the board as rotation vector and position, each with its RMS error in pixels; the best one first.

    A flat board has two: the true one, and one that leans the other way.
    """
    K = camera_matrix(intrinsics)
    count, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    found: list[tuple[float, Float64]] = []
    for number in range(count):
        turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, turns[number], shifts[number])
        pose = np.concatenate((np.ravel(turn), np.ravel(shift))).astype(np.float64)
        seen, _ = cv2.projectPoints(points, pose[:3], pose[3:], K, None)
        error_px = float(np.sqrt(((seen[:, 0] - pixels) ** 2).sum(axis=1).mean()))
        if pose[5] > 0 and np.isfinite(error_px):  # in front of the camera
            found.append((error_px, pose))
    found.sort(key=lambda solution: solution[0])
    distinct = [p for p in found[1:] if np.linalg.norm(p[1] - found[0][1]) > 1e-3]  # refined onto the same one
    return found[:1] + distinct


def pose_of_vector(pose: Float64) -> Float64:
    """(4, 4) of a rotation vector and a position (6,)."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(pose[:3])[0]
    T[:3, 3] = pose[3:]
    return T


def _position_sigma(points: Float64, pose: Float64, intrinsics: CameraIntrinsics, corner_px: float) -> float:
    """One-sigma uncertainty of the camera's position in metres, to first order, from that of the corners."""
    _, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], camera_matrix(intrinsics), None)
    by_pose = np.asarray(jacobian, np.float64)[:, :6]  # (2N, 6)
    covariance = corner_px**2 * np.linalg.pinv(by_pose.T @ by_pose)
    step = 1e-6
    columns = [
        (invert_pose(pose_of_vector(pose + d))[:3, 3] - invert_pose(pose_of_vector(pose - d))[:3, 3]) / (2 * step)
        for d in step * np.eye(6)
    ]
    by_position = np.stack(columns, axis=1)  # (3, 6)
    return float(np.sqrt(np.trace(by_position @ covariance @ by_position.T) / 3))
