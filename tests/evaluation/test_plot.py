import numpy as np
import pytest

from semantic_mapper.evaluation.canvas import PANEL
from semantic_mapper.evaluation.plot import Curve, draw_panel, ticks


def test_curves_are_drawn_where_their_points_are():
    panel = np.zeros((320, 460, 3), np.uint8)
    draw_panel(panel, "loss", [Curve("", ((0.0, 0.0), (100.0, 100.0)))])
    drawn = np.argwhere((np.abs(panel.astype(int) - (94, 180, 255)).sum(-1) < 60)[70:])
    first, last = drawn[drawn[:, 1].argmin()], drawn[drawn[:, 1].argmax()]
    assert first[0] > 200 and last[0] < 10, "from the lower left to the upper right"
    assert tuple(panel[2, 2]) == PANEL


def test_marked_points_are_seen():
    plain, marked = (np.zeros((320, 460, 3), np.uint8) for _ in range(2))
    points = ((0.0, 0.0), (50.0, 50.0), (100.0, 100.0))
    draw_panel(plain, "", [Curve("", points)])
    draw_panel(marked, "", [Curve("", points, marked=True)])
    rows, columns = np.nonzero((plain != marked).any(-1))
    assert len(rows) and (columns < 300).all(), "the last point is marked in both"


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 10, [0, 2, 4, 6, 8, 10]), (0, 0.98, [0, 0.2, 0.4, 0.6, 0.8, 1.0]), (0, 0, None), (-1, 1, None)],
)
def test_ticks_are_round_and_span_the_range(low: float, high: float, expected: list[float] | None):
    found = ticks(low, high)
    assert found[0] <= low and found[-1] >= high and 2 <= len(found) <= 8
    if expected is not None:
        assert found == pytest.approx(expected)
