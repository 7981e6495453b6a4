import io

import numpy as np
import pytest
from PIL import Image

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.poses.board import MARGIN_M, BoardFinder, BoardPoseSource, make_board, sheet_png
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import invert_pose, look_at
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8
from tests.drivers.calibrating.boards import picture

from .images import rigid

INTRINSICS = CameraIntrinsics(520.0, 525.0, 322.0, 238.0, 640, 480, (0.0, 0.0, 0.0, 0.0))
T_WORLD_BOARD = rigid((0.4, -0.2, 0.1), (1.0, 2.0, 3.0))
ROWS = tuple(tuple(row) for row in T_WORLD_BOARD.tolist())
CHARUCO = BoardPoses(columns=7, rows=5, square_m=0.05, marker_m=0.037, T_world_board=ROWS)
TAGS = BoardPoses(pattern="tags", columns=3, rows=2, square_m=0.1, marker_m=0.08, T_world_board=ROWS)
ONE_TAG = BoardPoses(pattern="tags", columns=1, rows=1, square_m=0.2, marker_m=0.2, T_world_board=ROWS)
OFFSETS = ((0.25, 0.1, -0.5), (-0.35, 0.1, -0.6), (0.1, -0.4, -0.7), (0.4, 0.35, -0.5))  # of the camera


def view(config: BoardPoses, offset: tuple[float, float, float]) -> tuple[Float64, CameraImage]:
    """T_board_camera of a camera so far from the middle of the board, and what it sees."""
    target = np.array((config.columns * config.square_m / 2, config.rows * config.square_m / 2, 0.0))
    T_board_camera = look_at(target + np.array(offset), target, np.array((0.05, -1.0, 0.0)))
    return T_board_camera, as_seen(picture(invert_pose(T_board_camera), INTRINSICS, config))


def as_seen(rgb: UInt8, intrinsics: CameraIntrinsics = INTRINSICS) -> CameraImage:
    return CameraImage(1, 0, "cam", rgb, None, intrinsics)


@pytest.mark.parametrize("config", [CHARUCO, TAGS, ONE_TAG], ids=["charuco", "tags", "one tag"])
def test_the_camera_is_found_where_it_is(config: BoardPoses) -> None:
    source = BoardPoseSource(config)
    errors, sigmas = [], []
    for offset in OFFSETS:
        T_board_camera, seen = view(config, offset)
        found = source.pose(seen)
        assert found is not None and found.source == "board", source.warnings
        truth = T_WORLD_BOARD @ T_board_camera
        errors.append(np.linalg.norm(found.T_world_camera[:3, 3] - truth[:3, 3]))
        sigmas.append(found.sigma)
        assert np.abs(found.T_world_camera[:3, :3] - truth[:3, :3]).max() < 0.02
    assert max(errors) < 0.01
    # What it says of its own error is right: three dimensions, so up to about four sigma.
    assert all(error < 5 * sigma for error, sigma in zip(errors, sigmas, strict=True))
    assert max(sigmas) < 0.02 and source.counters == {}


def test_too_little_of_a_board_wrong_intrinsics_and_small_boards_give_no_pose() -> None:
    """Head on nothing tells where the camera is; a little from the side two places fit."""
    _, seen = view(CHARUCO, OFFSETS[0])
    covered = seen.rgb.copy()
    covered[:, 290:] = 200
    wrong = CameraIntrinsics(520.0, 900.0, 322.0, 238.0, 640, 480)
    tiny = BoardPoses(pattern="tags", columns=1, rows=1, square_m=0.05, marker_m=0.05)
    for config, image, reason, says in (
        (CHARUCO, as_seen(np.full((480, 640, 3), 200, np.uint8)), "no_board", "0 corners"),
        (CHARUCO, as_seen(covered), "no_board", "corners of it are seen"),
        (CHARUCO, as_seen(seen.rgb, wrong), "inexact", "check its sizes"),
        (
            tiny,
            view(tiny, (0.0, 0.02, -0.9))[1],
            "uncertain ambiguous",
            "show it larger",
        ),  # either, by OpenCV's version
        (tiny, view(tiny, (0.08, 0.06, -0.8))[1], "ambiguous", "mirrored"),
    ):
        source = BoardPoseSource(config)
        assert source.pose(image) is None
        assert source.counters.total() == 1 and {*source.counters} <= {*reason.split()} and says in source.warnings[0]
    source = BoardPoseSource(CHARUCO)
    assert source.pose(as_seen(covered)) is None and source.pose(seen) is not None and source.warnings == ()


def test_boards_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match="no 'DICT_9X9'"):
        make_board(BoardPoses(dictionary="DICT_9X9"))
    with pytest.raises(ConfigError, match="50 markers, the board needs 200"):
        make_board(BoardPoses(dictionary="DICT_4X4_50", columns=20, rows=20))
    with pytest.raises(ConfigError, match="too large to be drawn"):
        sheet_png(BoardPoses(square_m=1.0, marker_m=0.8))


BOARDS = [BoardPoses(), BoardPoses(pattern="tags", columns=3, rows=2, square_m=0.06, marker_m=0.045)]


@pytest.mark.parametrize("board", BOARDS, ids=["charuco", "tags"])
def test_the_sheet_is_the_board_and_the_file_says_how_large_it_is(board: BoardPoses) -> None:
    data = sheet_png(board)
    picture = Image.open(io.BytesIO(data))
    a_metre = picture.info["dpi"][0] / 0.0254
    sheet = np.asarray(picture)
    assert max(sheet.shape) / a_metre < 0.297  # a sheet of A4 holds it
    points, pixels = BoardFinder(board).find(np.repeat(sheet[..., None], 3, axis=2))
    assert len(points) == 24
    off = pixels + 0.5 - (points[:, :2] + MARGIN_M) * a_metre
    assert np.abs(off).max() < 1.5  # of 12 pixels a millimetre
