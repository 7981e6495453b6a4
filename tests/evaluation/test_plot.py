import numpy as np
import pytest
from semantic_mapper.evaluation.canvas import PANEL
from semantic_mapper.evaluation.plot import Bar, Curve, Panel, draw_bars, draw_panel, draw_panels, ticks


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


def test_the_title_of_an_axis_stands_below_its_numbers_and_nothing_is_cut():
    plain, titled = (np.zeros((320, 460, 3), np.uint8) for _ in range(2))
    curve = Curve("", ((0.0, 0.0), (100.0, 100.0)))
    draw_panel(plain, "", [curve])
    draw_panel(titled, "", [curve], "classes (gjpqy)")
    text = np.argwhere((titled.astype(int).sum(-1) > 500) & (np.arange(320) > 285)[:, None])
    assert len(text) and text[:, 0].max() < 318 and 180 < text[:, 1].mean() < 340
    assert (plain[310:] == PANEL).all() and (titled[295:310] != PANEL).any()


def test_panels_stand_in_rows_under_the_title():
    panels = [Panel(f"{number}", (Curve("", ((0.0, 0.0), (1.0, 1.0))),)) for number in range(4)]
    alone, three, four = (draw_panels("title", panels[:count]) for count in (1, 3, 4))
    assert alone.shape == three.shape and four.shape[1] == three.shape[1]
    assert four.shape[0] - three.shape[0] > 300
    assert (four[: three.shape[0] - 24] == three[:-24]).all() and (four[-200:, 700:] == four[-1, -1]).all()


def test_bars_are_as_long_as_their_parts():
    picture = draw_bars("", [Bar("one", {"a": 60.0, "b": 20.0}), Bar("other", {"b": 40.0})], "ms").astype(int)
    counts = [(np.abs(picture - color).sum(-1) < 12).sum(axis=1) for color in ((94, 180, 255), (255, 164, 92))]
    a, b = (np.flatnonzero(count > 100) for count in counts)
    assert len(a) == 34 and len(b) == 2 * 34, "one bar has the first part, both the second"
    assert counts[0][a[0]] == pytest.approx(3 * counts[1][b[0]], abs=3)
    assert counts[1][b[-1]] == pytest.approx(2 * counts[1][b[0]], abs=3)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 10, [0, 2, 4, 6, 8, 10]),
        (0, 0.98, [0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (0, 0, [0, 0.2, 0.4, 0.6, 0.8, 1]),
        (-1, 1, None),
    ],
)
def test_ticks_are_round_and_span_the_range(low: float, high: float, expected: list[float] | None):
    found = ticks(low, high)
    assert found[0] <= low and found[-1] >= high and 2 <= len(found) <= 8
    if expected is not None:
        assert found == pytest.approx(expected)
