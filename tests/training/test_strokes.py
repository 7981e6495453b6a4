from dataclasses import replace

import numpy as np

from semantic_mapper.labels import ROOMS
from semantic_mapper.training.strokes import grow_strokes, labelled_fraction
from semantic_mapper.types import CameraIntrinsics, PosedFrame

H, W = 120, 160
WALL, FLOOR, CHAIR = (ROOMS.id_of(name) for name in ("wall", "floor", "chair"))


def frame(rgb: np.ndarray, depth_m: np.ndarray | None = None) -> PosedFrame:
    """A noisy image with strokes."""
    intrinsics = CameraIntrinsics(100.0, 100.0, 79.5, 59.5, W, H)
    noisy = (rgb + np.random.default_rng(0).normal(0, 1, rgb.shape)).clip(0, 255).astype(np.uint8)
    return PosedFrame(0, 0, "camera", noisy, depth_m, painted(), intrinsics, np.eye(4))


def painted() -> np.ndarray:
    """A stroke on each side of the middle."""
    label = np.full((H, W), ROOMS.ignore_id, np.uint8)
    label[55:65, 20:40], label[55:65, 120:140] = WALL, FLOOR
    return label


def test_strokes_grow_to_the_edges_of_the_image() -> None:
    rgb = np.full((H, W, 3), 90.0)
    rgb[:, W // 2 :] = 190
    grown = grow_strokes(frame(rgb), ROOMS).label
    assert grown is not None
    assert (grown[:, : W // 2 - 2] == WALL).mean() > 0.8 and (grown[:, W // 2 + 2 :] == FLOOR).mean() > 0.8
    assert not (grown[:, : W // 2 - 2] == FLOOR).any() and not (grown[:, W // 2 + 2 :] == WALL).any()


def test_depth_ends_strokes_where_colours_do_not() -> None:
    rgb, depth_m = np.full((H, W, 3), 120.0), np.full((H, W), 2.0, np.float32)
    depth_m[:, W // 2 :] = 2.6
    flat = grow_strokes(frame(rgb), ROOMS).label
    stepped = grow_strokes(frame(rgb, depth_m), ROOMS).label
    assert flat is not None and stepped is not None
    right = (stepped[:, : W // 2 - 2] == WALL).mean() + (stepped[:, W // 2 + 2 :] == FLOOR).mean()
    assert right > 1.6 > (flat[:, : W // 2 - 2] == WALL).mean() + (flat[:, W // 2 + 2 :] == FLOOR).mean()


def test_what_no_stroke_reaches_stays_unlabelled_and_what_is_painted_stays() -> None:
    rgb = np.full((H, W, 3), 90.0)
    rgb[20:100, 60:100] = 250
    given = frame(rgb)
    label = painted()
    label[0, 0] = CHAIR
    grown = grow_strokes(replace(given, label=label), ROOMS)
    assert grown.label is not None
    assert (grown.label[30:90, 65:95] == ROOMS.ignore_id).all()
    assert (grown.label[label != ROOMS.ignore_id] == label[label != ROOMS.ignore_id]).all()
    assert labelled_fraction([grown], ROOMS) > 5 * labelled_fraction([given], ROOMS)
