"""Images of a printed board as a camera with a lens sees them."""

from functools import cache

import cv2
import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibrating.views import MIN_CORNERS, BoardView
from semantic_mapper.drivers.poses.board import make_board
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.geometry import camera_matrix, invert_pose, look_at
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

BOARD = BoardPoses(columns=8, rows=6, square_m=0.04, marker_m=0.03)
LENS = CameraIntrinsics(421.0, 419.0, 326.0, 233.0, 640, 480, (-0.21, 0.06, 0.0008, -0.0006, 0.0))
SQUARE_PX = 60
MARGIN = 60
FINE = 2  # rendered this much larger, then averaged, as a sensor does


@cache
def _sheet(board: BoardPoses) -> UInt8:
    gap = 0 if board.pattern == "charuco" else 1 - board.marker_m / board.square_m
    size = [round((count - gap) * SQUARE_PX) + 2 * MARGIN for count in (board.columns, board.rows)]
    return np.asarray(make_board(board).generateImage(size, marginSize=MARGIN), np.uint8)


@cache
def _rays(lens: CameraIntrinsics) -> Float64:
    """(H * FINE, W * FINE, 2): where each fine pixel looks, x and y at depth 1."""
    v, u = np.mgrid[0 : lens.height * FINE, 0 : lens.width * FINE]
    pixels = (np.stack((u, v), axis=-1).reshape(-1, 1, 2) + 0.5) / FINE - 0.5
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-9)
    ideal = cv2.undistortImagePoints(pixels, camera_matrix(lens), np.array(lens.distortion), None, criteria)
    rays = (np.asarray(ideal, np.float64) - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    return rays.reshape(lens.height * FINE, lens.width * FINE, 2)


def picture(T_camera_board: Float64, lens: CameraIntrinsics = LENS, board: BoardPoses = BOARD) -> UInt8:
    """(H, W, 3) of the board in the plane z = 0, upper left corner at the origin, before a grey wall."""
    to_board = np.linalg.inv(T_camera_board[:3, [0, 1, 3]])  # of rays at depth 1, up to scale
    rays = _rays(lens)
    at = rays @ to_board[:, :2].T + to_board[:, 2]
    metres = at[..., :2] / at[..., 2:]
    on_sheet = (metres * (SQUARE_PX / board.square_m) + MARGIN - 0.5).astype(np.float32)
    behind = at[..., 2] * np.sign(np.linalg.det(to_board)) <= 0
    on_sheet[behind] = -1e6
    seen = cv2.remap(_sheet(board), on_sheet, None, cv2.INTER_LINEAR, borderValue=120)  # pyright: ignore[reportCallIssue, reportArgumentType]
    small = cv2.resize(seen, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    return np.repeat(np.asarray(small, np.uint8)[..., None], 3, axis=2)


def image(seq: int, T_camera_board: Float64, lens: CameraIntrinsics = LENS, camera_id: str = "cam") -> CameraImage:
    """As an uncalibrated camera gives it."""
    plain = CameraIntrinsics(500.0, 500.0, 319.5, 239.5, lens.width, lens.height)
    return CameraImage((seq + 1) * 1_000_000_000, seq, camera_id, picture(T_camera_board, lens), None, plain)


def views(count: int = 24, *, tilted: bool = True, aside: float = 1.0) -> list[Float64]:
    """T_camera_board of a board that is shown all over the image, leaning or not; ``aside`` 0: in the middle alone."""
    rng = np.random.default_rng(3)
    middle = np.array((BOARD.columns, BOARD.rows, 0.0)) * BOARD.square_m / 2
    found: list[Float64] = []
    for number in range(count):
        lean = rng.uniform(-0.7, 0.7, 2) if tilted else rng.uniform(-0.03, 0.03, 2)
        far = rng.uniform(0.34, 0.5)
        eye = middle + far * np.array((np.sin(lean[0]), np.sin(lean[1]), -1.0))
        T = invert_pose(look_at(eye, middle, np.array((0.05 * rng.normal(), -1.0, 0.0))))
        spot = np.array(((-1, 0, 1)[number % 3], (-1, 0, 1)[number // 3 % 3]), np.float64) + rng.uniform(-0.2, 0.2, 2)
        T[:2, 3] += aside * spot * far * np.array((0.42, 0.33))
        found.append(T)
    return found


@cache
def shown() -> tuple[tuple[Float64, CameraImage], ...]:
    """T_camera_board and picture of boards enough for a calibration; rendered once for all tests."""
    return tuple((T, image(seq, T)) for seq, T in enumerate(views(20)))


def made_up(T_camera_board: Float64, number: int, noise_px: float, rng: np.random.Generator) -> BoardView | None:
    """What finding corners in a picture would give, without the picture; None where too few are in it."""
    points = np.asarray(make_board(BOARD).getChessboardCorners(), np.float64).reshape(-1, 3)
    turn = cv2.Rodrigues(T_camera_board[:3, :3])[0]
    seen, _ = cv2.projectPoints(points, turn, T_camera_board[:3, 3], camera_matrix(LENS), np.array(LENS.distortion))
    pixels = np.asarray(seen, np.float64).reshape(-1, 2)
    inside = ((pixels > 2) & (pixels < (LENS.width - 3, LENS.height - 3))).all(axis=1)
    if inside.sum() < MIN_CORNERS:
        return None
    noise = rng.normal(0, noise_px, (int(inside.sum()), 2))
    return BoardView(str(number), number, points[inside], pixels[inside] + noise)
