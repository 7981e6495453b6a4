from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.poses.board import MARGIN_M, BoardFinder, BoardPoseSource, make_board, sheet_png
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import camera_matrix, invert_pose, look_at
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

from .images import rigid

INTRINSICS = CameraIntrinsics(520.0, 525.0, 322.0, 238.0, 640, 480)
CHARUCO = BoardPoses(columns=7, rows=5, square_m=0.05, marker_m=0.037)
TAGS = BoardPoses(pattern="tags", columns=3, rows=2, square_m=0.1, marker_m=0.08)
ONE_TAG = BoardPoses(pattern="tags", columns=1, rows=1, square_m=0.2, marker_m=0.2)
PIXELS_A_METRE = 4000
FINE = 3  # rendered this much larger, then averaged, as a sensor does


def size_of(config: BoardPoses) -> tuple[float, float]:
    """Width and height of the printed part, metres."""
    if config.pattern == "charuco":
        return config.columns * config.square_m, config.rows * config.square_m
    gap = config.square_m - config.marker_m
    return config.columns * config.square_m - gap, config.rows * config.square_m - gap


def render(config: BoardPoses, T_board_camera: Float64) -> CameraImage:
    """What a camera sees of the board, which lies in the plane z = 0 with its upper left corner at the origin."""
    width, height = size_of(config)
    margin = 100
    size = (round(width * PIXELS_A_METRE) + 2 * margin, round(height * PIXELS_A_METRE) + 2 * margin)
    sheet: UInt8 = make_board(config).generateImage(size, marginSize=margin)
    to_metres = np.array(
        [
            [1 / PIXELS_A_METRE, 0, (0.5 - margin) / PIXELS_A_METRE],  # pixel centres are integers
            [0, 1 / PIXELS_A_METRE, (0.5 - margin) / PIXELS_A_METRE],
            [0, 0, 1],
        ]
    )
    T_camera_board = invert_pose(T_board_camera)
    to_pixels = camera_matrix(INTRINSICS) @ T_camera_board[:3, [0, 1, 3]]
    finer = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1]])
    large = (INTRINSICS.width * FINE, INTRINSICS.height * FINE)
    seen = cv2.warpPerspective(sheet, finer @ to_pixels @ to_metres, large, flags=cv2.INTER_AREA, borderValue=255)
    small = cv2.resize(seen, (INTRINSICS.width, INTRINSICS.height), interpolation=cv2.INTER_AREA)
    rgb = np.repeat(np.asarray(small, np.uint8)[..., None], 3, axis=2)
    return CameraImage(1, 0, "cam", rgb, None, INTRINSICS)


def views(config: BoardPoses) -> list[Float64]:
    """T_board_camera of cameras in front of the board, at different sides and distances."""
    width, height = size_of(config)
    target = np.array((width / 2, height / 2, 0.0))
    offsets = ((0.25, 0.1, -0.5), (-0.35, 0.1, -0.6), (0.1, -0.4, -0.7), (0.4, 0.35, -0.5))
    return [look_at(target + np.array(offset), target, np.array((0.05, -1.0, 0.0))) for offset in offsets]


@pytest.mark.parametrize("config", [CHARUCO, TAGS, ONE_TAG], ids=["charuco", "tags", "one tag"])
def test_the_camera_is_found_where_it_is(config: BoardPoses) -> None:
    T_world_board = rigid((0.4, -0.2, 0.1), (1.0, 2.0, 3.0))
    rows = tuple(tuple(row) for row in T_world_board.tolist())
    source = BoardPoseSource(BoardPoses(**{**config_fields(config), "T_world_board": rows}))
    errors, sigmas = [], []
    for T_board_camera in views(config):
        found = source.pose(render(config, T_board_camera))
        assert found is not None and found.source == "board", source.warnings
        truth = T_world_board @ T_board_camera
        errors.append(np.linalg.norm(found.T_world_camera[:3, 3] - truth[:3, 3]))
        sigmas.append(found.sigma)
        assert np.abs(found.T_world_camera[:3, :3] - truth[:3, :3]).max() < 0.02
    assert max(errors) < 0.01
    # What it says of its own error is right: three dimensions, so up to about four sigma.
    assert all(error < 5 * sigma for error, sigma in zip(errors, sigmas, strict=True))
    assert max(sigmas) < 0.02 and source.counters == {}


def config_fields(config: BoardPoses) -> dict[str, object]:
    return {name: getattr(config, name) for name in config.__struct_fields__}


def test_no_board_and_too_little_of_it_give_no_pose() -> None:
    source = BoardPoseSource(CHARUCO)
    blank = CameraImage(1, 0, "cam", np.full((480, 640, 3), 200, np.uint8), None, INTRINSICS)
    assert source.pose(blank) is None
    assert source.counters["no_board"] == 1 and "0 corners" in source.warnings[0]
    seen = render(CHARUCO, views(CHARUCO)[0])
    covered = seen.rgb.copy()
    covered[:, 290:] = 200
    assert source.pose(CameraImage(2, 1, "cam", covered, None, INTRINSICS)) is None
    assert source.pose(seen) is not None and source.warnings == ()


def test_wrong_intrinsics_are_noticed() -> None:
    source = BoardPoseSource(CHARUCO)
    seen = render(CHARUCO, views(CHARUCO)[1])
    wrong = CameraIntrinsics(520.0, 900.0, 322.0, 238.0, 640, 480)
    assert source.pose(CameraImage(1, 0, "cam", seen.rgb, None, wrong)) is None
    assert source.counters["inexact"] == 1 and "check its sizes" in source.warnings[0]


def test_a_small_board_is_not_guessed_at() -> None:
    """Head on nothing tells where the camera is; a little from the side two places fit."""
    tiny = BoardPoses(pattern="tags", columns=1, rows=1, square_m=0.05, marker_m=0.05)
    target = np.array((0.025, 0.025, 0.0))
    source = BoardPoseSource(tiny)
    for offset in ((0.0, 0.02, -0.8), (0.08, 0.06, -0.8)):
        camera = look_at(target + np.array(offset), target, np.array((0.0, -1.0, 0.0)))
        assert source.pose(render(tiny, camera)) is None
    assert source.counters == {"uncertain": 1, "ambiguous": 1} and "mirrored" in source.warnings[0]


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
