from __future__ import annotations

import numpy as np
from semantic_mapper.evaluation.path_plot import draw_top_view

GREEN, ORANGE = (130, 214, 130), (255, 164, 92)


def test_paths_are_seen_from_above_at_one_scale() -> None:
    corner = np.array([[0.0, 0, 0], [0, 0, 1], [2, 0, 1], [2, 0, 2], [4, 0, 2]])  # y is up: drawn are x and z
    gap = corner.copy()
    gap[:, 1] += 50  # height is not seen
    gap[2] = np.nan
    picture = draw_top_view("a title", {"first": corner, "second": gap}, np.array((0.0, 1.0, 0.0)))
    inside = picture[80:720, 60:870]
    rows, columns = np.nonzero((inside == GREEN).all(axis=-1))
    width, height = np.ptp(columns), np.ptp(rows)
    assert 1.2 < width / height < 4  # 4 m by 2 m, less what the longest way is turned by
    assert (inside == ORANGE).all(axis=-1).sum() > 100
    only = draw_top_view("a title", {"second": gap}, np.array((0.0, 1.0, 0.0)))
    whole = draw_top_view("a title", {"second": corner}, np.array((0.0, 1.0, 0.0)))
    assert (only == GREEN).all(axis=-1).sum() < 0.7 * (whole == GREEN).all(axis=-1).sum()  # no line across the gap
