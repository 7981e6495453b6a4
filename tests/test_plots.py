import os
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from semantic_mapper.labels import ROOMS
from semantic_mapper.plots import (
    UNKNOWN,
    class_colors,
    class_rows,
    cut,
    new_figure,
    put_legend,
    put_title,
    rendered,
    text_width,
)
from tests.figures import figure_of

HOSTILE = ("$\\frac{", "a\x1b[2J\nb", "turned\u202eback", "\u6f22\u5b57", "_hidden", "%d {0}", "w" * 100_000, "")


@rendered
def draw_names(names: tuple[str, ...]) -> Figure:
    figure = new_figure(400, 300)
    put_title(figure, names[0], names[-1])
    put_legend(figure, (24, 80, 352, 200), [(name, UNKNOWN, 0.5) for name in names])
    return figure


def test_names_are_text_whatever_they_hold_and_settings_of_the_process_stay(recwarn: pytest.WarningsRecorder) -> None:
    before = dict(matplotlib.rcParams)
    assert draw_names(HOSTILE).std() > 1 and not recwarn.list
    assert dict(matplotlib.rcParams) == before
    texts = [text.get_text() for axes in figure_of(draw_names, ("a title", "a\x1b[2J")).axes for text in axes.texts]
    assert r"a\x1b[2J" in texts


def test_long_text_is_cut_to_its_width() -> None:
    for text in ("a very long name of a class", "W" * 100, "i" * 100, "word " * 100_000):
        short = cut(text, 80, 11)
        assert short.endswith("…") and 60 < text_width(short, 11) <= 80
    assert cut("wall", 80, 11) == "wall" and len(cut("wall", 1, 11)) <= 1


def test_matplotlib_is_imported_when_something_is_drawn_and_says_nothing_of_a_home_without_room() -> None:
    code = (
        "import sys; import semantic_mapper.nodes.cli.main, semantic_mapper.replay.page; "
        "from semantic_mapper.plots import new_figure, rendered; "
        "print({'matplotlib', 'PIL'} & set(sys.modules)); rendered(lambda: new_figure(9, 9))(); "
        "print('matplotlib.pyplot' in sys.modules)"
    )
    homeless = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "MPL"))}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**homeless, "HOME": "/proc/none"}, check=True
    )
    assert done.stdout.split() == ["set()", "False"] and done.stderr == ""


def test_unknown_is_grey_and_the_last_of_the_legend() -> None:
    unknown, wall, bed = ROOMS.ignore_id, ROOMS.id_of("wall"), ROOMS.id_of("bed")
    colors = class_colors(np.array([unknown, wall], np.uint8), ROOMS)
    np.testing.assert_array_equal(colors, [UNKNOWN, ROOMS.colors[ROOMS.names.index("wall")]])
    labels = np.array([unknown, unknown, wall, unknown], np.uint8)
    rows = class_rows(labels, ROOMS, [np.full((2, 2), bed, np.uint8)])
    assert [(name, fraction) for name, _, fraction in rows] == [("wall", 0.25), ("bed", 0.0), ("unknown", 0.75)]
