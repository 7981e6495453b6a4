"""The camera's pose from a printed board that it sees: ChArUco, or a grid of AprilTags; and the board to be printed."""

import io
from typing import Any

import cv2
import numpy as np
from PIL import Image

from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import camera_matrix, invert_pose, make_pose, rotation_vector
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

PIXELS_A_METRE = 11811  # of the board to be printed: 300 dots an inch, about
MARGIN_M = 0.005  # white, all round; the words stand in the lower one
LARGEST_PX = 30_000  # a side
MIN_CORNER_SIGMA_PX = 0.2  # corners are found no better than this, however well a few of them happen to fit
MIN_CORNERS = 6  # seen, for a pose; a single tag has 4
MAX_ERROR_PX = 1.5  # RMS reprojection error of a pose that is used
MAX_SIGMA_M = 0.05  # of the camera's position
MIN_FLIP_RATIO = 1.5  # a flat board's mirrored pose must fit so much worse


def make_board(config: BoardPoses) -> Any:
    """The cv2.aruco board of a config; ``ConfigError`` where OpenCV has no such dictionary, or one too small."""
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
        return cv2.aruco.CharucoBoard(size, config.square_m, config.marker_m, dictionary)
    gap_m = config.square_m - config.marker_m if config.columns * config.rows > 1 else config.marker_m
    return cv2.aruco.GridBoard(size, config.marker_m, gap_m, dictionary)


def sheet_png(config: BoardPoses) -> bytes:
    """The board with its margin as a PNG file that says how large it is; squares have a whole number of pixels.

    Raises ConfigError: a board that cannot be, or too large to be drawn.
    """
    square_px = max(8, round(config.square_m * PIXELS_A_METRE))
    a_metre = square_px / config.square_m
    gap_px = 0 if config.pattern == "charuco" else round((config.square_m - config.marker_m) * a_metre)
    width, height = config.columns * square_px - gap_px, config.rows * square_px - gap_px
    margin = round(MARGIN_M * a_metre)
    if max(width, height) + 2 * margin > LARGEST_PX:
        raise ConfigError(
            f"a board of {width / a_metre:.2f} x {height / a_metre:.2f} m is too large to be drawn at {a_metre:.0f} "
            "pixels a metre; have it printed from a drawing of your own"
        )
    sheet = np.full((height + 2 * margin, width + 2 * margin), 255, np.uint8)
    sheet[margin : margin + height, margin : margin + width] = make_board(config).generateImage(
        (width, height), marginSize=0
    )
    words = (
        f"{config.pattern} {config.columns} x {config.rows}, {1000 * config.square_m:g} mm a square, marker "
        f"{1000 * config.marker_m:g} mm. Print at 100 %, then measure a square."
    )
    scale = 0.6 * margin / 32  # Hershey letters are about 32 pixels high at 1
    place = (margin, height + 2 * margin - round(0.25 * margin))
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(2 * scale))
    cv2.putText(sheet, words, place, font, scale, 90, thickness, cv2.LINE_AA)
    data, dpi = io.BytesIO(), 0.0254 * round(a_metre)
    Image.fromarray(sheet).save(data, "PNG", dpi=(dpi, dpi))
    return data.getvalue()


class BoardFinder:
    """Finds the corners of a board in images; ``ConfigError`` where there can be no such board."""

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
        points = pixels = None
        if ids is not None and len(ids):
            points, pixels = self._board.matchImagePoints(corners, ids)
        if points is None or pixels is None:  # no markers, or of other boards
            return np.zeros((0, 3)), np.zeros((0, 2))
        return np.asarray(points, np.float64).reshape(-1, 3), np.asarray(pixels, np.float64).reshape(-1, 2)


class BoardPoseSource(PoseSource):
    """Finds the board in every image; ``ConfigError`` where there can be no such board.

    Attributes:
        counters: Images without a pose: "no_board" (too few corners seen), "inexact" (reprojection error), "ambiguous"
            (the mirrored pose fits nearly as well), "uncertain" (the corners leave the position open:
            the board is too small in the image).
    """

    def __init__(self, config: BoardPoses) -> None:
        super().__init__()
        self._finder = BoardFinder(config)
        self._min_corners = min(MIN_CORNERS, 4 * config.columns * config.rows)
        self._T_world_board = np.array(config.T_world_board)

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of a rectified image; None where the board is not seen well enough, see ``counters``."""
        points, pixels = self._finder.find(image.rgb)
        if len(points) < self._min_corners:
            return self._refuse("no_board", f"{len(points)} corners of it are seen, {self._min_corners} needed")
        solutions = board_poses(points, pixels, image.intrinsics)
        if not solutions:
            return self._refuse("no_board", "its corners allow no pose")
        (error_px, T_camera_board), others = solutions[0], solutions[1:]
        if error_px > MAX_ERROR_PX:
            return self._refuse(
                "inexact", f"its corners are off by {error_px:.1f} px; check its sizes and the camera's"
            )
        corner_px = max(error_px, MIN_CORNER_SIGMA_PX)
        if others and others[0][0] < MIN_FLIP_RATIO * corner_px:
            return self._refuse("ambiguous", "its mirrored pose fits as well; show it larger, or from the side")
        sigma = _position_sigma(points, T_camera_board, image.intrinsics, corner_px)
        if sigma > MAX_SIGMA_M:
            return self._refuse("uncertain", f"it gives the camera's place to {sigma:.2f} m only; show it larger")
        self._warnings = ()
        return PoseEstimate(self._T_world_board @ invert_pose(T_camera_board), "board", sigma)

    def _refuse(self, reason: str, detail: str) -> None:
        self._counters[reason] += 1
        self._warnings = (f"the board gives no pose: {detail}",)


def board_poses(points: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> list[tuple[float, Float64]]:
    """T_camera_board (4, 4) of corners (N, 3) seen at pixels (N, 2), each with its RMS error in pixels, the best first.

    A flat board has two: the true one, and one that leans the other way.
    """
    K = camera_matrix(intrinsics)
    _, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    found: list[tuple[float, Float64]] = []
    for first_turn, first_shift in zip(turns, shifts, strict=True):
        turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, first_turn, first_shift)
        seen, _ = cv2.projectPoints(points, turn, shift, K, None)
        error_px = float(np.sqrt(((seen[:, 0] - pixels) ** 2).sum(axis=1).mean()))
        if shift[2] > 0 and np.isfinite(error_px):  # in front of the camera
            found.append((error_px, make_pose(np.ravel(turn), np.ravel(shift))))
    found.sort(key=lambda solution: solution[0])
    distinct = [p for p in found[1:] if np.linalg.norm(p[1] - found[0][1]) > 1e-3]  # refined onto the same one
    return found[:1] + distinct


def _position_sigma(points: Float64, T_camera_board: Float64, intrinsics: CameraIntrinsics, corner_px: float) -> float:
    """One-sigma uncertainty of the camera's position in metres, to first order, from that of the corners."""
    turn, shift = rotation_vector(T_camera_board), T_camera_board[:3, 3]
    _, jacobian = cv2.projectPoints(points, turn, shift, camera_matrix(intrinsics), None)
    by_pose = np.asarray(jacobian, np.float64)[:, :6]  # (2N, 6)
    covariance = corner_px**2 * np.linalg.pinv(by_pose.T @ by_pose)
    R, R_by_turn = cv2.Rodrigues(turn)
    by_turn = R_by_turn.reshape(3, 3, 3).transpose(0, 2, 1) @ shift
    by_position = np.hstack((by_turn.T, R.T))  # (3, 6), of the position -R.T @ shift, up to its sign
    return float(np.sqrt(np.trace(by_position @ covariance @ by_position.T) / 3))
