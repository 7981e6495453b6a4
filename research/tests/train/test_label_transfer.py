"""Labels from boxes alone, and from boxes at measured depth with predicted labels."""

from __future__ import annotations

import numpy as np

from research.train.label_transfer import box_crf, nearest_labels
from semantic_mapper.fields.scene.boxes import PrimitiveSet
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.labels import KITTI360
from semantic_mapper.types import CameraIntrinsics, PosedFrame, UInt8

CAMERA = CameraIntrinsics(20.0, 20.0, 19.5, 14.5, 40, 30)
CAR, WALL, SKY = (KITTI360.id_of(name) for name in ("car", "wall", "sky"))


def box(number: int, name: str, x: float, z: float, deep: float = 1.0, thing: bool = False) -> Primitive:
    T = np.eye(4)
    T[:3, 3] = (x, 0, z)
    return Primitive(number, name, "box", T, np.array([4.0, 8.0, deep]), thing)


BOXES = PrimitiveSet([box(1, "car", -2, 5, thing=True), box(2, "wall", 0, 8)])  # the car hides the wall's left half


def frame(depth_m: float) -> PosedFrame:
    rgb = np.full((30, 40, 3), 120, np.uint8)
    rgb[:, 20:] = 220  # an edge where the car ends
    depth = np.full((30, 40), depth_m, np.float32)
    depth[:, 20:] = 8
    return PosedFrame(0, 0, "c", rgb, depth, None, CAMERA, np.eye(4))


def predicted(left: int, right: int) -> UInt8:
    label = np.full((30, 40), right, np.uint8)
    label[:, :20] = left
    return label


def test_a_pixel_has_the_class_and_the_number_of_the_first_box() -> None:
    found = nearest_labels(frame(5), BOXES, KITTI360, "sky")
    assert found.label[15, 15] == CAR and found.instance[15, 15] == 1
    assert found.label[15, 22] == WALL and found.instance[15, 22] == 0, "walls are no things"
    assert found.label[15, 39] == SKY, "no box there"


def test_boxes_at_the_measured_depth_correct_what_was_predicted() -> None:
    found = box_crf(frame(5), BOXES, predicted(WALL, CAR), KITTI360)
    inner = np.s_[10:20, 14:18], np.s_[10:20, 22:24]
    assert (found.label[inner[0]] == CAR).all() and (found.instance[inner[0]] == 1).all()
    assert (found.label[inner[1]] == WALL).all() and (found.instance == 0)[inner[1]].all()


def test_what_was_predicted_decides_where_boxes_overlap_and_where_none_is() -> None:
    both = PrimitiveSet([box(1, "car", -2, 5, thing=True), box(2, "wall", -2, 5)])
    for said in (CAR, WALL):
        found = box_crf(frame(5), both, predicted(said, SKY), KITTI360)
        assert (found.label[10:20, 12:18] == said).all()
        assert (found.label[10:20, 30:] == SKY).all(), "no box there"
    holes = box_crf(frame(0), BOXES, predicted(CAR, WALL), KITTI360)
    assert (holes.label[10:20, 12:18] == CAR).all()
    assert (holes.instance[10:20, 12:18] == 1).all(), "the box on the ray tells which car"


def test_what_nothing_is_known_of_is_as_its_neighbours_of_like_colour() -> None:
    label = predicted(CAR, WALL)
    label[14, [8, 19, 20, 30]] = KITTI360.ignore_id
    found = box_crf(frame(0), PrimitiveSet([]), label, KITTI360)
    assert found.label[14, [8, 19, 20, 30]].tolist() == [CAR, CAR, WALL, WALL], "the edge lies between 19 and 20"
