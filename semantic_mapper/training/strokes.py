"""Strokes grow over pixels that look like them: label images of a few painted lines become ones to learn from.

Each class's strokes are smoothed along the edges of the image and of its depth (a global weighted least squares filter:
Min et al., *Fast Global Image Smoothing Based on Weighted Least Squares*, 2014; scribbles as data term: Levin et al.,
*Colorization using Optimization*, 2004). A pixel gets the class of the strokes that reach it, where hardly any other
class does; what no stroke reaches stays unlabelled.
"""

from dataclasses import replace

import cv2
import numpy as np

from semantic_mapper.errors import FrameError
from semantic_mapper.imaging import resize_depth, resize_label, resize_rgb, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, PosedFrame, UInt8

# Chosen on strokes of two scenes, `python -m research.experiments.label_strokes`.
WIDTH = 160  # of the image that is looked at: how far a stroke reaches counts in its pixels
REACH, EDGE = 3000.0, 3.0  # of the filter: its lambda, and the difference of guides that is an edge
REACHED = 1e-4  # of a stroke's weight
ALONE = 0.9  # fraction of the weight that has to be of one class
DEPTH_LEVELS = 180.0  # of the guide for one dioptre


def grow_strokes(frame: PosedFrame, label_set: LabelSet) -> PosedFrame:
    """A frame whose label image has grown from its strokes, up to edges of image and depth; painted pixels stay.
    Raises FrameError: it has no label image."""
    if frame.label is None:
        raise FrameError(f"frame seq={frame.seq} has no label image whose strokes could grow")
    k = working_intrinsics(frame.intrinsics, WIDTH)
    painted = resize_label(frame.label, k)
    guide = _guide(resize_rgb(frame, k), resize_depth(frame, k))
    ids = np.array(label_set.ids, np.uint8)
    weight = np.stack(
        [cv2.ximgproc.fastGlobalSmootherFilter(guide, (painted == i).astype(np.float32), REACH, EDGE) for i in ids]
    )
    whole = weight.sum(0)
    sure = (whole > REACHED) & (weight.max(0) > ALONE * whole)
    grown = np.where(sure, ids[weight.argmax(0)], label_set.ignore_id).astype(np.uint8)
    height, width = frame.label.shape
    grown = cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST)
    kept = frame.label != label_set.ignore_id
    return replace(frame, label=np.where(kept, frame.label, grown).astype(np.uint8))


def labelled_fraction(frames: list[PosedFrame], label_set: LabelSet) -> float:
    """Fraction of the pixels of label images that have a class."""
    labels = [frame.label for frame in frames if frame.label is not None]
    return sum(int((label != label_set.ignore_id).sum()) for label in labels) / max(1, sum(x.size for x in labels))


def _guide(rgb: UInt8, depth_m: Float32) -> UInt8:
    """(H, W, 3) whose edges are those of lightness, of hue, and of inverse depth."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
    hue = 2 * (lab[..., 1] - 128) + 2 * (lab[..., 2] - 128) + 128
    near = np.where(depth_m > 0, DEPTH_LEVELS / np.maximum(depth_m, 0.2), 0)
    return np.dstack((lab[..., 0], hue, near)).clip(0, 255).astype(np.uint8)
