"""Changes to files of boxes, on files as the reader takes them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.box_edits import BoxEditor, with_times
from semantic_mapper.replay.boxes import BoxFile, load_boxes, read_boxes, save_boxes
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.messages import StreamInfo
from tests.small import tiny_frames


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
        (lambda e: e.resize(3, np.array([1, 0, 1.0])), "box 3: size must be at least 0.001 m"),
        (lambda e: e.move(3, np.array([np.nan, 0, 0])), "box 3: values must be numbers"),
        (lambda e: e.turn(3, np.inf), "box 3: values must be numbers"),
        (lambda e: e.move(3, np.zeros(3), 5), "box 3: stands still"),
        (lambda e: e.move(3, np.array([1e9, 0, 0])), r"box 3: T_world_box: the box is at \[1"),
        (lambda e: e.resize(7, np.array([1, 1e-9, 1.0])), "box 7: size must be at least"),
        (lambda e: e.resize(3, np.array([1, 1, 1e6])), "box 3: size must be metres within 100 km"),
        (lambda e: e.reclass(3, ""), "box 3: class must be the name"),
        (lambda e: e.turn(9, 1.0, 150), "box 9: has no pose at 150 ns, but at 100, 200"),
        (lambda e: e.add_time(9, 100), "box 9: has a pose at 100 ns already"),
        (lambda e: e.add_time(9, -1), "box 9: stamps must be whole numbers of nanoseconds from 0"),
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


def test_boxes_that_cannot_be_used_are_taken_out_and_none_is_left(tmp_path: Path) -> None:
    path = tmp_path / "boxes.json"
    good = {"id": 1, "class": "chair", "T_world_box": np.eye(4).tolist(), "size": [1, 1, 1]}
    path.write_text(json.dumps({"boxes": [good, good | {"id": 70000}, good | {"id": 3, "size": [1, 1, 0]}]}))
    editor = BoxEditor(path, read_boxes(path))
    with pytest.raises(ConfigError, match=r"box 3 \(id 3\): size"):
        editor.delete([70000])
    editor.delete([3, 70000])
    assert [p.id for p in editor.boxes.primitives] == [1]


@pytest.fixture
def by_frame(editor: BoxEditor) -> BoxEditor:
    """Box 7 is at 5, 6, 7 ... at these frames, box 9 at a frame that no log here has."""
    far = tuple((number, pose(number, 0, 1)) for number in (5, 7, 8))
    still, wall, car = editor.boxes.primitives
    wall = replace(wall, frames=far, T_world_box=far[0][1])
    car = replace(car, stamps=None, frames=((90, pose(0, 0, 0)),), T_world_box=pose(0, 0, 0))
    save_boxes(editor.path, replace(editor.boxes, primitives=(still, wall, car)))
    return BoxEditor(editor.path, load_boxes(editor.path))


def test_poses_by_frame_take_the_times_of_a_log_of_their_drive(by_frame: BoxEditor, tmp_path: Path) -> None:
    frames = [replace(f, seq=5 + i) for i, f in enumerate(tiny_frames(3))]
    for name, source in (("drive", "kitti360 2013_05_28_drive_0000_sync"), ("robot", "my robot")):
        info = StreamInfo(source, {f.camera_id: f.intrinsics for f in frames}, ROOMS)
        with LogWriter(tmp_path / f"{name}.mcap", info) as writer:
            for frame in frames:
                writer.write_frame(frame)
    with open_log(tmp_path / "drive.mcap") as log:
        timed, dropped = with_times(by_frame.boxes, by_frame.path, log)
    with (
        open_log(tmp_path / "robot.mcap") as log,
        pytest.raises(ConfigError, match=r"boxes\.json: boxes have poses by frame.*'my robot'"),
    ):
        with_times(by_frame.boxes, by_frame.path, log)
    still, wall = timed.primitives
    assert dropped == [9] and not still.moves and wall.frames is None
    assert [(t, T[0, 3]) for t, T in wall.stamps or ()] == [(frames[0].stamp_ns, 5), (frames[2].stamp_ns, 7)]


def test_poses_by_frame_move_together_and_have_no_times_to_change(by_frame: BoxEditor) -> None:
    by_frame.move(7, np.array([0, 1.0, 0]))
    wall = box(by_frame, 7)
    assert [(n, T[:3, 3].tolist()) for n, T in wall.frames or ()] == [(n, [n, 1, 1]) for n in (5, 7, 8)]
    for edit in (lambda: by_frame.move(7, np.zeros(3), 5), lambda: by_frame.add_time(7, 5)):
        with pytest.raises(ConfigError, match=r"box 7: has poses by frame and no times.*times LOG"):
            edit()
