"""mIoU against seconds of fitting, as a picture."""

from typing import Any

import numpy as np
from semantic_mapper.benchmark.fit_plot import draw_fit_curves

BLUE, ORANGE = (94, 180, 255), (255, 164, 92)


def figures(curve: list[tuple[float, float | None]], carried: float | None) -> dict[str, Any]:
    return {"curve": [{"seconds": s, "miou": m} for s, m in curve], "carried_miou": carried}


def drawn(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return np.argwhere((np.abs(picture.astype(int) - color).sum(-1) < 60) & (np.arange(len(picture)) > 130)[:, None])


def test_a_better_field_is_drawn_above_a_worse_one() -> None:
    good, bad = [(0.0, 0.5), (30.0, 0.8)], [(0.0, None), (10.0, 0.1), (30.0, 0.3)]
    picture = draw_fit_curves({"good": figures(good, None), "bad": figures(bad, None)}, "fit")
    assert picture is not None
    assert drawn(picture, BLUE)[:, 0].max() < drawn(picture, ORANGE)[:, 0].min()


def test_carried_labels_are_a_level_line() -> None:
    picture = draw_fit_curves({"field": figures([(0.0, 0.2), (30.0, 0.3)], 0.9)}, "fit")
    assert picture is not None
    rows, columns = drawn(picture, ORANGE).T
    assert np.ptp(rows) < 12 and np.ptp(columns) > 500


def test_nothing_is_drawn_where_nothing_was_fitted() -> None:
    assert draw_fit_curves({"field": figures([], None)}, "generalize") is None
