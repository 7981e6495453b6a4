from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.lines import Line2D
from matplotlib.text import Text

from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.overview import ViewStrip, draw_overview
from semantic_mapper.labels import ROOMS
from tests.evaluation.room_points import Points, class_id, room_points
from tests.figures import figure_of, misplaced_texts

UP = np.array([0.0, 0, 1])


def strip(**changed: object) -> ViewStrip:
    label = np.full((24, 32), class_id("wall"), np.uint8)
    label[12:] = class_id("floor")
    depth = np.linspace(1, 3, 24 * 32, dtype=np.float32).reshape(24, 32)
    whole = ViewStrip("frame 5", np.full((24, 32, 3), 90, np.uint8), label, label, depth)
    return replace(whole, **changed)  # type: ignore[arg-type]


def no_points() -> Points:
    return Points(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8), np.zeros(0, np.float32)
    )


def share_of(picture: np.ndarray, name: str) -> float:
    color = np.array(ROOMS.colors[ROOMS.names.index(name)])
    return float((np.abs(picture.astype(int) - color).max(axis=-1) < 12).mean())


def test_the_picture_shows_every_part() -> None:
    picture = draw_overview([strip()], room_points(), ROOMS, title="room", subtitle="1 frame", up=UP)
    assert picture.shape[1] == 1600 and picture.dtype == np.uint8
    assert share_of(picture, "floor") > 0.02 and share_of(picture, "wall") > 0.02
    figure = figure_of(draw_overview, [strip()], room_points(), ROOMS, title="room", subtitle="1 frame", up=UP)
    assert not misplaced_texts(figure)
    assert {"room", "1 frame", "frame 5: camera", "truth", "wall", "1 m"} <= {
        t.get_text() for t in figure.findobj(Text)
    }


def test_computed_surface_is_striped_and_the_legend_says_how_much() -> None:
    points = room_points()
    half = points.xyz[:, 0] < 2.0
    figure = figure_of(draw_overview, [], replace(points, measured=~half), ROOMS, title="room", up=UP)
    assert not misplaced_texts(figure)
    said = {t.get_text() for t in figure.findobj(Text)}
    assert f"striped = computed: {100 * half.mean():.0f} %" in said
    assert "paler in the map = less sure" in said
    plain = draw_overview([], replace(points, measured=np.ones_like(half)), ROOMS, title="room", up=UP)
    assert np.array_equal(plain, draw_overview([], points, ROOMS, title="room", up=UP))
    striped = draw_overview([], replace(points, measured=~half), ROOMS, title="room", up=UP)
    above = [picture[120:700, 24:680].astype(int).mean(axis=-1) for picture in (plain, striped)]
    darker = above[1] < above[0] - 20
    left, right = np.array_split(darker, 2, axis=1)
    assert 0.05 < max(left.mean(), right.mean()) < 0.5 and min(left.mean(), right.mean()) < 0.02
    figure = figure_of(draw_overview, [], replace(points, measured=half & ~half), ROOMS, title="room", up=UP)
    assert not misplaced_texts(figure)
    assert "all of it computed, no sensor" in {t.get_text() for t in figure.findobj(Text)}


def test_rooms_are_drawn_where_they_are_as_a_floor_plan_lies() -> None:
    points = room_points()
    turned = replace(points, xyz=points.xyz @ turn_about_up(np.deg2rad(30)).T.astype(np.float32))
    outline = np.array(((0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0))) @ turn_about_up(np.deg2rad(30)).T
    figure = figure_of(draw_overview, [], turned, ROOMS, title="room", up=UP, rooms=[("room 7: 12 m²", outline)])
    assert "room 7: 12 m²" in {t.get_text() for t in figure.findobj(Text)} and not misplaced_texts(figure)
    x, y = next(line for line in figure.findobj(Line2D) if len(line.get_xdata()) == 5).get_data()
    sides = np.diff(np.stack((x, -y), axis=1).astype(float), axis=0)
    assert np.rad2deg(np.arctan2(*sides[0][::-1])) == pytest.approx(30, abs=0.5), "x of the world is to the right"
    assert np.linalg.norm(sides[0]) / np.linalg.norm(sides[1]) == pytest.approx(4 / 3, rel=1e-3)


def turn_about_up(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array(((c, -s, 0), (s, c, 0), (0, 0, 1.0)))


def test_lengths_have_the_unit_that_they_are_in() -> None:
    figure = figure_of(draw_overview, [strip()], room_points(), ROOMS, title="room", up=UP, unit="units")
    said = " ".join(t.get_text() for t in figure.findobj(Text))
    assert "1 units" in said and "1.0 units (red)" in said and "1 m" not in said


def test_the_view_from_above_looks_under_the_ceiling() -> None:
    picture = draw_overview([], room_points(), ROOMS, title="room", up=UP)
    from_above = picture[100:, :660]
    assert np.array_equal(ROOMS.names[2], "ceiling")
    assert share_of(from_above, "ceiling") == 0
    assert (np.abs(from_above.astype(int) - ROOMS.colors[ROOMS.names.index("table")]).max(axis=-1) < 60).any()


@pytest.mark.parametrize("without", [{"truth": None}, {"depth_m": None}, {"truth": None, "depth_m": None}])
def test_what_a_stream_lacks_is_left_out(without: dict[str, None]) -> None:
    whole = draw_overview([strip()], room_points(0.1), ROOMS, title="room", up=UP)
    part = draw_overview([strip(**without)], room_points(0.1), ROOMS, title="room", up=UP)
    assert part.shape[0] > whole.shape[0]  # fewer tiles in a row are larger


def test_an_empty_map_and_depth_without_measurements_can_be_drawn() -> None:
    blind = strip(depth_m=np.zeros((24, 32), np.float32))
    picture = draw_overview([blind], no_points(), ROOMS, title="nothing yet")
    assert picture.shape[1] == 1600


def test_rendered_labels_of_a_smaller_size_fill_their_tile() -> None:
    small = strip(rendered=np.full((6, 8), class_id("bed"), np.uint8))
    assert share_of(draw_overview([small], no_points(), ROOMS, title="room"), "bed") > 0.05


def test_arrays_of_the_map_that_do_not_fit_together_are_refused() -> None:
    points = room_points(0.2)
    with pytest.raises(ShapeError, match="map points"):
        draw_overview([], replace(points, label=points.label[1:]), ROOMS, title="room")
