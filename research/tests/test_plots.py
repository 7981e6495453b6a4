from __future__ import annotations

import numpy as np
import pytest

from research.plots import Curve, Panel, draw_panels, draw_paths
from tests.figures import figure_of, misplaced_texts

RISING = Curve("rising", [(0.0, 0.0), (100.0, 80.0)])


def test_curves_have_their_points_and_panels_of_the_same_curves_share_a_legend() -> None:
    panels = [Panel("a", "ms", "x", [RISING]), Panel("b", "ms", "x", [RISING]), Panel("c", "ms", "x", [])]
    figure = figure_of(draw_panels, "title", panels)
    assert list(map(tuple, figure.axes[0].lines[0].get_xydata())) == list(RISING.points)
    assert len(figure.legends) == 1 and all(axes.get_legend() is None for axes in figure.axes)
    assert [text.get_text() for text in figure.axes[2].texts] == ["nothing yet"]
    assert not misplaced_texts(figure)


def test_paths_are_seen_from_above_at_one_scale() -> None:
    corner = np.array([[0.0, 0, 0], [0, 0, 1], [2, 0, 1], [2, 0, 2], [4, 0, 2]])  # y is up: drawn are x and z
    broken = corner + np.array((0.0, 50.0, 0.0))  # height is not seen
    broken[2] = np.nan
    figure = figure_of(draw_paths, "a title", {"first": corner, "second": broken}, np.array((0.0, 1.0, 0.0)))
    first, start, second, _ = (np.asarray(line.get_xydata()) for line in figure.axes[0].lines)
    steps = np.linalg.norm(np.diff(first, axis=0), axis=1)
    assert steps == pytest.approx([1, 2, 1, 2]), "lengths on the ground are as in the world"
    assert start == pytest.approx(first[:1]) and np.isnan(second[2]).all(), "no line where it was interrupted"
    assert figure.axes[0].get_aspect() == 1 and not misplaced_texts(figure)
