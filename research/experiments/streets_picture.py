"""A picture of STREETS' first street, after ``benchmark streets --arm panoptic``: images, boxes of things, predicted
labels, what Panoptic NeRF says (classes, things, depth), and the truth. Where cars drive, also what it says without
boxes that move.

Example: python -m research.experiments.streets_picture --folder runs/streets-grids --out street.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from research.scenes.sequence import RoomView
from research.scenes.suite import STREETS_SUITE
from research.scenes.survey import depth_picture
from research.suites.streets import (
    Drive,
    StreetsConfig,
    drive,
    primitives_at,
    scored_views,
    street_seeds,
)
from research.suites.streets_panoptic import STILL, render_answer, street_field
from semantic_mapper.config import load_config
from semantic_mapper.fields.panoptic import Panoptic
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import make_label_set
from semantic_mapper.plots import draw_picture_rows
from semantic_mapper.replay.box_picture import edges_in_view
from semantic_mapper.types import UInt8

COLUMNS, WIDTH_PX, FINER = 3, 340, 3
BOXES_M = 40.0  # boxes further away are not drawn


def picture(config: StreetsConfig, folder: Path) -> UInt8:
    """(H, W, 3) of the first street; its field is fitted where ``folder`` has none."""
    label_set = STREETS_SUITE.label_set
    street = drive(config, street_seeds(config)[0])
    field = street_field(config, street, "panoptic", folder)
    views = scored_views(config, street)
    views = [views[int(k)] for k in np.linspace(0, len(views) - 1, COLUMNS).round()]
    said = [render_answer(field, view.frame) for view in views]
    rows = {
        "image": [view.frame.rgb for view in views],
        "boxes of things": [with_boxes(view, street, field) for view in views],
        "predicted labels": [label_set.colorize(street.pseudo[view.frame.seq]) for view in views],
        "Panoptic NeRF": [label_set.colorize(answer.label) for answer in said],
        **without_moving_boxes(config, street, views, folder),
        "true classes": [label_set.colorize(view.rendered.label) for view in views],
        "things found": [thing_colors(answer.instance) for answer in said],
        "depth found": [depth_picture(answer.depth_m / np.float32(6)) for answer in said if answer.depth_m is not None],
    }
    return draw_picture_rows(rows, label_set, WIDTH_PX)


def without_moving_boxes(
    config: StreetsConfig, street: Drive, views: list[RoomView], folder: Path
) -> dict[str, list[UInt8]]:
    """Classes that it says if boxes that move are left out; nothing where no car drives."""
    if not config.moving:
        return {}
    field = street_field(config, street, STILL, folder)
    label_set = STREETS_SUITE.label_set
    return {"moving left out": [label_set.colorize(render_answer(field, v.frame).label) for v in views]}


def with_boxes(view: RoomView, street: Drive, field: Panoptic) -> UInt8:
    """The image with the edges of the boxes of things that are near."""
    k, T_camera_world = view.frame.intrinsics, invert_pose(view.T_world_camera)
    image = cv2.resize(view.frame.rgb, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_CUBIC)
    colors = dict(zip(field.label_set.names, field.label_set.colors, strict=True))
    for box in primitives_at(street.boxes, view.frame.seq).primitives:
        z = float((T_camera_world @ box.T_world_box[:, 3])[2])
        if not box.thing or not 0 < z < BOXES_M:
            continue
        for ends in edges_in_view(box, view.T_world_camera, k):
            (x0, y0), (x1, y1) = (np.clip((ends + 0.5) * FINER, -1e5, 1e5)).round().astype(int).tolist()
            cv2.line(image, (x0, y0), (x1, y1), colors[box.class_name], 2, cv2.LINE_AA)
    return np.asarray(image, np.uint8)


def thing_colors(instance: np.ndarray | None) -> UInt8:
    """A colour for each id, black where there is no thing."""
    assert instance is not None
    ids, where = np.unique(instance, return_inverse=True)
    colors = np.array(make_label_set("things", [str(i) for i in ids]).colors, np.uint8)
    colors[ids == 0] = 0
    return colors[where].reshape(*instance.shape, 3)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    config = load_config(arguments.config, StreetsConfig) if arguments.config else StreetsConfig()
    image = picture(config, arguments.folder)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 65])


if __name__ == "__main__":
    main()
