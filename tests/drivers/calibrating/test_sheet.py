"""The printed board: of true size, and found again in its own picture."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.calibrating.sheet import MARGIN_M, draw_sheet, sheet_png
from semantic_mapper.drivers.poses.board import BoardFinder
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError

BOARDS = [BoardPoses(), BoardPoses(pattern="tags", columns=3, rows=2, square_m=0.06, marker_m=0.045)]


@pytest.mark.parametrize("board", BOARDS, ids=["charuco", "tags"])
def test_the_sheet_is_the_board_in_its_true_size(board: BoardPoses) -> None:
    sheet, a_metre = draw_sheet(board)
    points, pixels = BoardFinder(board).find(np.repeat(sheet[..., None], 3, axis=2))
    assert len(points) == 24
    off = pixels + 0.5 - (points[:, :2] + MARGIN_M) * a_metre
    assert np.abs(off).max() < 1.5  # of 12 pixels a millimetre


def test_the_file_says_how_large_it_is() -> None:
    data = sheet_png(BoardPoses())
    place = data.index(b"pHYs")
    x, y, unit = struct.unpack(">IIB", data[place + 4 : place + 13])
    assert x == y and unit == 1
    assert struct.unpack(">I", data[place + 13 : place + 17])[0] == zlib.crc32(data[place : place + 13])
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    height, width = np.asarray(read).shape
    assert (width / x, height / y) == pytest.approx((0.29, 0.21), abs=2e-4)  # a sheet of A4 holds it
    np.testing.assert_array_equal(read, draw_sheet(BoardPoses())[0])


def test_a_wall_is_no_sheet() -> None:
    with pytest.raises(ConfigError, match="too large to be drawn"):
        sheet_png(BoardPoses(square_m=1.0, marker_m=0.8))
