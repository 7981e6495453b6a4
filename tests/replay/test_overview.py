from dataclasses import replace

import numpy as np
import pytest
from matplotlib.lines import Line2D
from matplotlib.text import Text

from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.overview import ViewStrip, draw_overview, draw_points, hides_the_room
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
    from_above = draw_overview([], room_points(), ROOMS, title="room", up=UP)[100:, :660]
    assert share_of(from_above, "ceiling") == 0, "it is cut away"
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
    figure = figure_of(
        draw_overview, [], turned, ROOMS, title="room", up=UP, rooms=[("room 7: 12 m²", outline, outline.mean(0))]
    )
    assert "room 7: 12 m²" in {t.get_text() for t in figure.findobj(Text)} and not misplaced_texts(figure)
    x, y = next(line for line in figure.findobj(Line2D) if len(line.get_xdata()) == 5).get_data()
    sides = np.diff(np.stack((x, -y), axis=1).astype(float), axis=0)
    assert np.rad2deg(np.arctan2(*sides[0][::-1])) == pytest.approx(30, abs=0.5), "x of the world is to the right"
    assert np.linalg.norm(sides[0]) / np.linalg.norm(sides[1]) == pytest.approx(4 / 3, rel=1e-3)


def turn_about_up(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array(((c, -s, 0), (s, c, 0), (0, 0, 1.0)))


def test_what_a_stream_lacks_is_left_out_and_an_empty_map_can_be_drawn() -> None:
    whole = draw_overview([strip()], no_points(), ROOMS, title="nothing yet")
    for without in ({"truth": None}, {"depth_m": None}, {"truth": None, "depth_m": None}):
        part = draw_overview([strip(**without)], no_points(), ROOMS, title="nothing yet")
        assert part.shape[0] > whole.shape[0]  # fewer tiles in a row are larger
    blind = strip(depth_m=np.zeros((24, 32), np.float32))
    assert draw_overview([blind], no_points(), ROOMS, title="nothing yet").shape == whole.shape


BLACK = (0, 0, 0)


def square(center: tuple[float, float, float], color: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.5, 0.5, 40))
    xyz = np.stack((a.ravel(), b.ravel(), 0 * a.ravel()), axis=1) + center
    return xyz, np.tile(np.array(color, np.uint8), (len(xyz), 1))


def test_the_nearer_of_two_surfaces_is_drawn_without_holes() -> None:
    near, red = square((0, 0, 1), (255, 0, 0))
    far, blue = square((0, 0, 2), (0, 0, 255))
    for order in (1, -1):
        xyz, colors = np.concatenate((near, far)[::order]), np.concatenate((red, blue)[::order])
        picture, _ = draw_points(xyz, colors, (80, 80), BLACK)
        inner = picture[10:-10, 10:-10]
        assert inner[..., 0].min() > 150 and inner[..., 2].max() == 0


def test_walls_on_the_viewers_side_are_left_out_and_nothing_else() -> None:
    points = room_points()
    inside = points.label != class_id("ceiling")
    xyz, label = points.xyz[inside].astype(np.float64), points.label[inside]
    hidden = hides_the_room(xyz, azimuth=0.0)  # from +x
    near_wall = (xyz[:, 0] > 3.9) & (xyz[:, 2] > 0.2)
    assert hidden[near_wall].mean() > 0.95
    assert hidden[(xyz[:, 0] < 2) | (label == class_id("table")) | (label == class_id("floor"))].mean() < 0.01
