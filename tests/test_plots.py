from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.labels import KLEVR, ROOMS
from semantic_mapper.plots import (
    UNKNOWN,
    Bar,
    Curve,
    Histogram,
    Panel,
    PercentileBox,
    class_colors,
    class_rows,
    cut,
    draw_bars,
    draw_boxes,
    draw_histograms,
    draw_panels,
    draw_paths,
    draw_picture_rows,
    text_width,
    write_picture,
)
from tests.figures import figure_of, misplaced_texts

RISING = Curve("rising", [(0.0, 0.0), (100.0, 80.0)])
HOSTILE = ("$\\frac{", "a\x1b[2J\nb", "turned\u202eback", "\u6f22\u5b57", "_hidden", "%d {0}", "w" * 100_000, "")


def test_curves_have_their_points_and_names() -> None:
    figure = figure_of(
        draw_panels, "a title", [Panel("loss", "loss", "step", [RISING, Curve("level", [(0, 5), (9, 5)])])]
    )
    (axes,) = figure.axes
    assert list(map(tuple, axes.lines[0].get_xydata())) == list(RISING.points)
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left")) == ("step", "loss", "loss")
    legend = axes.get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["rising", "level"]
    assert axes.get_xlim()[0] == 0 and axes.get_ylim()[0] == 0 and axes.get_ylim()[1] > 80
    assert not misplaced_texts(figure)


def test_panels_of_the_same_curves_share_a_legend_and_empty_ones_say_so() -> None:
    panels = [Panel("a", "ms", "x", [RISING]), Panel("b", "ms", "x", [RISING]), Panel("c", "ms", "x", [])] * 2
    figure = figure_of(draw_panels, "title", panels)
    assert len(figure.axes) == 6 and len(figure.legends) == 1 and all(axes.get_legend() is None for axes in figure.axes)
    assert [text.get_text() for text in figure.axes[2].texts] == ["nothing yet"]
    assert not misplaced_texts(figure)
    one, two = (draw_panels("title", panels[:count]) for count in (3, 6))
    assert one.dtype == np.uint8 and two.shape[1] == one.shape[1] and two.shape[0] > one.shape[0] + 300


def test_marked_and_single_points_are_seen() -> None:
    curves = [Curve("", RISING.points, marked=True), RISING, Curve("", [(3.0, 4.0)])]
    (axes,) = figure_of(draw_panels, "", [Panel("", "", "", curves)]).axes
    assert [line.get_marker() for line in axes.lines] == ["o", "", "o"]


def test_bars_are_as_long_as_their_parts() -> None:
    bars = [Bar("one", {"a": 60.0, "b": 20.0}), Bar("other", {"b": 40.0})]
    figure = figure_of(draw_bars, "bars", bars, "ms")
    (axes,) = figure.axes
    spans = [[(bar.get_x(), bar.get_width()) for bar in part] for part in axes.containers]
    assert spans == [[(0, 60), (0, 0)], [(60, 20), (0, 40)]], "one bar has the first part, both the second"
    assert {"60.0", "20.0", " 80.0", " 40.0"} <= {text.get_text() for text in axes.texts}
    assert not misplaced_texts(figure)


def test_a_bar_of_nothing_says_so() -> None:
    (axes,) = figure_of(draw_bars, "", [Bar("refrigerator", {"IoU": 0.0}), Bar("wall", {"IoU": 94.0})], "IoU, %").axes
    assert {" 0.0", " 94.0"} <= {text.get_text() for text in axes.texts}
    assert draw_bars("", [Bar("only", {"IoU": 0.0})], "IoU, %").std() > 1


def test_paths_are_seen_from_above_at_one_scale() -> None:
    corner = np.array([[0.0, 0, 0], [0, 0, 1], [2, 0, 1], [2, 0, 2], [4, 0, 2]])  # y is up: drawn are x and z
    gap = corner + np.array((0.0, 50.0, 0.0))  # height is not seen
    gap[2] = np.nan
    figure = figure_of(draw_paths, "a title", {"first": corner, "second": gap}, np.array((0.0, 1.0, 0.0)))
    first, start, second, _ = (np.asarray(line.get_xydata()) for line in figure.axes[0].lines)
    steps = np.linalg.norm(np.diff(first, axis=0), axis=1)
    assert steps == pytest.approx([1, 2, 1, 2]), "lengths on the ground are as in the world"
    assert np.ptp(first, axis=0)[0] > np.ptp(first, axis=0)[1], "the longest way goes to the right"
    assert start == pytest.approx(first[:1]) and np.isnan(second[2]).all(), "no line across a gap"
    assert figure.axes[0].get_aspect() == 1 and not misplaced_texts(figure)


def test_names_are_text_whatever_they_hold() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in HOSTILE:
            curve = Curve(name, RISING.points)
            for picture in (
                draw_panels(name, [Panel(name[:40], "", "", [curve])]),
                draw_bars(name, [Bar(name, {name: 1.0, "other": 2.0})], "ms"),
                draw_paths(name, {name: np.eye(3)}, np.array((0.0, 0.0, 1.0))),
            ):
                assert picture.std() > 1
        (axes,) = figure_of(draw_panels, "", [Panel("", "", "", [Curve("a\x1b[2J", RISING.points)])]).axes
    legend = axes.get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == [r"a\x1b[2J"]


def test_long_text_is_cut_to_its_width() -> None:
    for text in ("a very long name of a class", "W" * 100, "i" * 100, "word " * 100_000):
        short = cut(text, 80, 11)
        assert short.endswith("…") and 60 < text_width(short, 11) <= 80
    assert cut("wall", 80, 11) == "wall" and len(cut("wall", 1, 11)) <= 1


def test_drawing_leaves_the_settings_of_the_process_as_they_are() -> None:
    before = dict(matplotlib.rcParams)
    draw_panels("", [Panel("", "", "", [RISING])])
    assert dict(matplotlib.rcParams) == before


def test_matplotlib_is_imported_when_something_is_drawn() -> None:
    """The command line starts without it, and machines that only train lack it."""
    code = (
        "import sys; import semantic_mapper.nodes.cli.main, semantic_mapper.replay.page, semantic_mapper.plots; "
        "import research.train.train_log, research.suites.run; "
        "print({'matplotlib', 'PIL'} & set(sys.modules)); "
        "semantic_mapper.plots.draw_panels('', [semantic_mapper.plots.Panel('', '', '', [])]); "
        "print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["set()", "False"]


def test_a_home_that_cannot_be_written_to_is_no_news() -> None:
    code = "from semantic_mapper.plots import Panel, draw_panels; draw_panels('', [Panel('', '', '', [])])"
    homeless = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "MPL"))}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**homeless, "HOME": "/proc/none"}, check=True
    )
    assert done.stdout == done.stderr == ""


def test_pictures_are_written_or_say_why_not(tmp_path: Path) -> None:
    picture = draw_bars("", [Bar("one", {"a": 1.0})], "ms")
    write_picture(tmp_path / "new" / "bars.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "bars.png"))[..., ::-1], picture)
    (tmp_path / "file").touch()
    with pytest.raises(SemanticMapperError, match=r"bars\.png: cannot be written"):
        write_picture(tmp_path / "file" / "bars.png", picture)


def test_unknown_is_grey_and_the_last_of_the_legend() -> None:
    unknown, wall, bed = ROOMS.ignore_id, ROOMS.id_of("wall"), ROOMS.id_of("bed")
    colors = class_colors(np.array([unknown, wall], np.uint8), ROOMS)
    np.testing.assert_array_equal(colors, [UNKNOWN, ROOMS.colors[ROOMS.names.index("wall")]])
    labels = np.array([unknown, unknown, wall, unknown], np.uint8)
    rows = class_rows(labels, ROOMS, [np.full((2, 2), bed, np.uint8)])
    assert [(name, fraction) for name, _, fraction in rows] == [("wall", 0.25), ("bed", 0.0), ("unknown", 0.75)]


def test_rows_of_pictures_have_captions_and_all_classes_below() -> None:
    tiles = [KLEVR.colorize(np.full((8, 12), number, np.uint8)) for number in KLEVR.ids[:3]]
    rows = {"image": tiles, "true classes": tiles[:2], "U-Net": tiles}
    figure = figure_of(draw_picture_rows, rows, KLEVR, 180)
    assert misplaced_texts(figure) == []
    texts = [text.get_text() for axes in figure.axes for text in axes.texts if text.get_text()]
    assert sorted(texts) == sorted((*rows, *KLEVR.names))
    picture = draw_picture_rows(rows, KLEVR, 180)
    for color in KLEVR.colors[:3]:
        assert (picture == color).all(-1).sum() >= 2 * 180 * 120


def test_histograms_count_values_and_mark_the_median() -> None:
    shown = [
        Histogram("miou", "", np.array([0.1, 0.2, 0.2, 0.4, np.nan])),
        Histogram("frames", "", np.full(7, 3.0)),
        Histogram("nothing", "", np.array([np.nan])),
    ]
    figure = figure_of(draw_histograms, shown)
    heights = [sum(patch.get_height() for patch in axes.patches) for axes in figure.axes]
    assert heights == [4, 7, 0]
    assert figure.axes[0].lines[0].get_xdata()[0] == pytest.approx(0.2)
    assert figure.axes[0].get_title("right") == "median 0.2" and figure.axes[0].get_legend() is None
    assert not misplaced_texts(figure)


def test_single_values_are_visible_and_no_figure_lies_on_the_axes() -> None:
    boxes = [PercentileBox("one", (0.4,) * 5, 1), PercentileBox("many", (0.1, 0.2, 0.3, 0.5, 1.0), 12)]
    figure = figure_of(draw_boxes, "", boxes, "IoU")
    (axes,) = figure.axes
    panel, medians = axes.get_facecolor(), axes.collections[-1].get_colors()
    assert np.abs(np.subtract(medians[0], panel)).max() > 0.5, "light on the dark panel"
    assert np.abs(np.subtract(medians[1], axes.patches[1].get_facecolor())).max() > 0.5, "dark on its box"
    right = axes.get_window_extent().x1
    assert [text.get_text() for text in axes.texts] == ["0.4  n = 1", "0.3  n = 12"]
    assert all(text.get_window_extent().x0 >= right for text in axes.texts)


def test_boxes_reach_from_quartile_to_quartile() -> None:
    boxes = [PercentileBox(name, (0.1, 0.2, 0.3, 0.5, 0.9), 12) for name in (*HOSTILE[:5], "room")]
    figure = figure_of(draw_boxes, "a title", boxes, "IoU")
    (axes,) = figure.axes
    assert [(p.get_x(), round(p.get_width(), 6)) for p in axes.patches] == [(0.2, 0.3)] * len(boxes)
    assert axes.get_yticklabels()[-1].get_text() == "room"
    assert not misplaced_texts(figure)
