from __future__ import annotations

import numpy as np

from research.evaluation.sheet import SheetRow, draw_sheet
from semantic_mapper.labels import ROOMS
from semantic_mapper.plots import UNKNOWN

WALL, BED = (ROOMS.ids[ROOMS.names.index(n)] for n in ("wall", "bed"))


def row(**labels: np.ndarray) -> SheetRow:
    truth = np.full((24, 32), WALL, np.uint8)
    return SheetRow("room 1", np.full((24, 32, 3), 90, np.uint8), truth, labels, dict.fromkeys(labels, "mIoU 50 %"))


def shows(picture: np.ndarray, color: tuple[int, int, int]) -> float:
    return float((np.abs(picture.astype(int) - color).max(axis=-1) < 3).mean())


def test_each_method_has_a_column_and_a_missing_one_stays_empty() -> None:
    bed = np.full((24, 32), BED, np.uint8)
    sheet = draw_sheet([row(a=bed), row(a=bed, b=bed)], ["a", "b"], ROOMS, title="sheet")
    one = draw_sheet([row(a=bed)], ["a"], ROOMS, title="sheet")
    assert sheet.shape[1] > one.shape[1] and sheet.shape[0] > one.shape[0]
    tile = 320 * 240
    assert shows(sheet, ROOMS.colors[ROOMS.names.index("bed")]) * sheet[..., 0].size >= 3 * tile
    assert shows(sheet, ROOMS.colors[ROOMS.names.index("wall")]) * sheet[..., 0].size >= 2 * tile
    assert shows(sheet, UNKNOWN) * sheet[..., 0].size < 200
    unknown = draw_sheet([row(a=np.full((24, 32), ROOMS.ignore_id, np.uint8))], ["a"], ROOMS, title="sheet")
    assert shows(unknown, UNKNOWN) * unknown[..., 0].size > 320 * 240
