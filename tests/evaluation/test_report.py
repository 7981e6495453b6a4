from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from semantic_mapper.evaluation.canvas import UNKNOWN, draw_text, new_canvas, shorten, text_width
from semantic_mapper.evaluation.report import ViewStrip, class_colors, draw_overview, write_overview

from semantic_mapper.errors import SemanticMapperError, ShapeError
from semantic_mapper.evaluation import canvas
from semantic_mapper.labels import ROOMS
from tests.evaluation.room_points import Points, class_id, room_points

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


def test_the_picture_is_written_and_shows_every_part(tmp_path: Path) -> None:
    path = tmp_path / "overview.png"
    write_overview(path, [strip()], room_points(), ROOMS, title="room", subtitle="1 frame", up=UP)
    picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    assert picture.shape[1] == 1600
    np.testing.assert_array_equal(
        picture, draw_overview([strip()], room_points(), ROOMS, title="room", subtitle="1 frame", up=UP)
    )
    assert share_of(picture, "floor") > 0.02 and share_of(picture, "wall") > 0.02


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


def test_unknown_is_grey_in_pictures() -> None:
    colors = class_colors(np.array([ROOMS.ignore_id, class_id("wall")], np.uint8), ROOMS)
    np.testing.assert_array_equal(colors, [UNKNOWN, ROOMS.colors[0]])


def test_arrays_of_the_map_that_do_not_fit_together_are_refused() -> None:
    points = room_points(0.2)
    with pytest.raises(ShapeError, match="map points"):
        draw_overview([], replace(points, label=points.label[1:]), ROOMS, title="room")


def test_a_picture_that_cannot_be_written_is_an_error_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(SemanticMapperError, match=r"absent.*overview\.png"):
        write_overview(tmp_path / "absent" / "overview.png", [], no_points(), ROOMS, title="room")


def test_long_text_is_cut_to_its_width_and_stays_on_the_canvas() -> None:
    cut = shorten("a very long name of a class", 80, 15)
    assert cut.endswith("...") and text_width(cut, 15) <= 80
    assert shorten("wall", 80, 15) == "wall"
    canvas = new_canvas(40, 20)
    draw_text(canvas, "wider than the canvas Küche", (30, 10), 15, (255, 255, 255))
    draw_text(canvas, "", (0, 0), 15, (255, 255, 255))
    assert canvas.shape == (20, 40, 3)


def test_a_name_without_an_end_is_cut_in_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[int] = []
    width = canvas.text_width
    monkeypatch.setattr(canvas, "text_width", lambda text, height: measured.append(len(text)) or width(text, height))
    text = canvas.shorten("word " * 100_000, 600, 20)
    assert text.endswith("...") and width(text, 20) <= 600 < width("word " * len(text), 20)
    assert len(measured) <= 12 and max(measured) <= 603
