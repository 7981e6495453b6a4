"""Changes to files of boxes, on files as the reader takes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.geometry import check_pose
from semantic_mapper.replay.box_edits import BoxEditor
from semantic_mapper.replay.boxes import BoxFile, load_boxes, save_boxes


def pose(*center: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = center
    return T


@pytest.fixture
def editor(tmp_path: Path) -> BoxEditor:
    square = np.array([(-1.0, -1), (1, -1), (1, 1), (-1, 1)])
    first, later = (100, pose(0, 0, 1)), (200, pose(2, 0, 1))
    primitives = (
        Primitive(3, "chair", "box", pose(1, 2, 0.5), np.array([0.5, 0.4, 1]), True),
        Primitive(7, "wall", "prism", pose(0, 3, 1), np.array([2.0, 2, 2.5]), False, polygon=square),
        Primitive(9, "car", "box", first[1], np.array([4, 2, 1.5]), True, stamps=(first, later)),
    )
    path = tmp_path / "boxes.json"
    save_boxes(path, BoxFile(primitives, {"car": ("car", "truck")}))
    return BoxEditor(path, load_boxes(path))


def box(editor: BoxEditor, box_id: int) -> Primitive:
    """As it reads after it was written."""
    save_boxes(editor.path, editor.boxes)
    return next(p for p in load_boxes(editor.path).primitives if p.id == box_id)


def test_boxes_are_deleted_and_the_rest_stays_byte_for_byte(editor: BoxEditor) -> None:
    lines = editor.path.read_text().splitlines()
    editor.delete([3, 9])
    save_boxes(editor.path, editor.boxes)
    kept = editor.path.read_text().splitlines()
    assert [kept[0], kept[1], kept[-1]] == [lines[0], lines[2].rstrip(","), lines[-1]] and len(kept) == 3


def test_another_class_decides_whether_a_box_is_a_thing(editor: BoxEditor) -> None:
    editor.reclass(3, "floor")
    assert (box(editor, 3).class_name, box(editor, 3).thing) == ("floor", False)
    editor.boxes = BoxFile(
        (*editor.boxes.primitives, Primitive(12, "building", "box", pose(9, 9, 0), np.ones(3), True))
    )
    editor.reclass(3, "building")
    assert box(editor, 3).thing, "as the other building of this file, which is stuff elsewhere"


def test_a_box_moves_along_the_axes_of_the_world_and_turns_round_its_own(editor: BoxEditor) -> None:
    editor.turn(3, np.pi / 2)
    editor.move(3, np.array([0.1, 0, -0.2]))
    moved = box(editor, 3)
    np.testing.assert_allclose(moved.T_world_box[:3, 3], (1.1, 2, 0.3))
    np.testing.assert_allclose(moved.T_world_box[:3, 0], (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(np.ptp(moved.corners(), axis=0), (0.4, 0.5, 1))
    for _ in range(1000):
        editor.turn(3, 0.1)
    check_pose(box(editor, 3).T_world_box, "after a thousand turns")


def test_a_size_is_along_a_boxs_own_axes_and_outlines_scale_with_it(editor: BoxEditor) -> None:
    editor.turn(7, np.pi / 2)
    editor.resize(7, np.array([4.0, 1, 3]))
    prism = box(editor, 7)
    np.testing.assert_allclose(np.ptp(prism.mesh()[0], axis=0), (1, 4, 3))
    np.testing.assert_allclose(prism.mesh()[0].mean(axis=0), (0, 3, 1), atol=1e-12)


def test_a_copy_has_the_next_id_and_moves_alone(editor: BoxEditor) -> None:
    assert editor.duplicate(3) == 10
    editor.move(10, np.array([1.0, 0, 0]))
    assert box(editor, 10).T_world_box[0, 3] == 2 and box(editor, 3).T_world_box[0, 3] == 1
    assert (box(editor, 10).class_name, box(editor, 10).size.tolist()) == ("chair", [0.5, 0.4, 1])


def test_a_moving_box_moves_at_one_time_or_at_all(editor: BoxEditor) -> None:
    editor.move(9, np.array([0, 1.0, 0]), 200)
    editor.move(9, np.array([0, 0, 0.5]))
    car = box(editor, 9)
    assert [(t, T[:3, 3].tolist()) for t, T in car.stamps or ()] == [(100, [0, 0, 1.5]), (200, [2, 1, 1.5])]
    np.testing.assert_array_equal(car.T_world_box, next(iter(car.stamps or ()))[1])


def test_a_box_is_duplicated_over_time_with_the_pose_of_the_nearest_time(editor: BoxEditor) -> None:
    editor.add_time(9, 190)
    editor.add_time(9, 50)
    assert [(t, T[0, 3]) for t, T in box(editor, 9).stamps or ()] == [(50, 0), (100, 0), (190, 2), (200, 2)]
    editor.add_time(3, 70)
    still = box(editor, 3)
    assert [(t, T[:3, 3].tolist()) for t, T in still.stamps or ()] == [(70, [1, 2, 0.5])]


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda e: e.delete([3, 4]), "has no box 4; it has 3, 7, 9"),
        (lambda e: e.resize(3, np.array([1, 0, 1.0])), "box 3: sizes must be above 0"),
        (lambda e: e.move(3, np.array([np.nan, 0, 0])), "box 3: values must be numbers"),
        (lambda e: e.turn(3, np.inf), "box 3: values must be numbers"),
        (lambda e: e.move(3, np.zeros(3), 5), "box 3: stands still"),
        (lambda e: e.turn(9, 1.0, 150), "box 9: has no pose at 150 ns, but at 100, 200"),
        (lambda e: e.add_time(9, 100), "box 9: has a pose at 100 ns already"),
        (lambda e: e.add_time(9, -1), "box 9: a time must not be below 0"),
    ],
)
def test_what_cannot_be_names_the_file_and_the_box_and_changes_nothing(editor: BoxEditor, edit, says: str) -> None:
    before = editor.boxes
    with pytest.raises(ConfigError, match=says) as error:
        edit(editor)
    assert str(editor.path) in str(error.value) and editor.boxes is before


def test_the_answer_of_a_query_becomes_a_file_of_boxes(tmp_path: Path) -> None:
    thing = {
        "id": 5,
        "class": "chair",
        "box": {"center": [1, 2, 3], "size": [1, 0.5, 2], "R_world_box": np.eye(3).tolist()},
    }
    path = tmp_path / "things.json"
    path.write_text(json.dumps({"question": "instances", "up": [0, 0, 1], "instances": [thing, thing | {"id": 6}]}))
    editor = BoxEditor(path, load_boxes(path))
    editor.delete([6])
    save_boxes(path, editor.boxes)
    once, again = editor.boxes.primitives[0], load_boxes(path).primitives[0]
    np.testing.assert_array_equal(once.size, again.size)
