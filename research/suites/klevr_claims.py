"""The claims of NeSF as checks on KLEVR, and the figures of an arm that they are about."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from research.scenes.suite import KLEVR_SUITE
from research.suites.claims import Claim, Measure, miou_measure
from research.suites.klevr import POINTS, TEST_CAMERAS, TRAIN_CAMERAS
from semantic_mapper.types import Float64

_BACKGROUND = KLEVR_SUITE.label_set.names.index("background")


def _background(counts: Sequence[Float64]) -> Float64:
    """What the background's IoU adds to the mean, in points."""
    c = counts[0]
    hits, occurring = c[:, _BACKGROUND, _BACKGROUND], c.sum(axis=2)
    union = occurring[:, _BACKGROUND] + c[:, :, _BACKGROUND].sum(axis=1) - hits
    return 100 * hits / np.maximum(union, 1) / np.maximum((occurring > 0).sum(axis=1), 1)


TRAIN_MIOU = miou_measure(f"mIoU, {TRAIN_CAMERAS}", TRAIN_CAMERAS)
TEST_MIOU = miou_measure(f"mIoU, {TEST_CAMERAS}", TEST_CAMERAS)
POINTS_MIOU = miou_measure(f"mIoU, {POINTS}", POINTS)
BACKGROUND = Measure(f"of it background, {TRAIN_CAMERAS}", (TRAIN_CAMERAS,), _background)
MEASURES = (TRAIN_MIOU, BACKGROUND, TEST_MIOU, POINTS_MIOU)

# Turned scenes, more vertices and images need more steps than what they are compared with: these claims need plateaus.
# Label maps and views are compared after the same steps. The others compare one arm's figures.
_ROTATION, _GRIDS = ("nesf", "nesf-no-rotation"), ("nesf-grid-64", "nesf-grid-32")
_MAPS, _VIEWS = ("nesf-1-map", "nesf"), ("nesf-25-views", "nesf-5-views")
CLAIMS = (
    Claim("gate: the colour of a pixel says little", "", TRAIN_MIOU, "color", most=30.0),
    Claim("rotation augmentation", "3D 75.5 -> 97.1", POINTS_MIOU, *_ROTATION, least=5.0, at_plateau=_ROTATION),
    Claim("3D above 2D", "97.8 / 92.7", POINTS_MIOU, "nesf", "nesf", TRAIN_MIOU, least=2.0),
    Claim("grid 32 -> 64", "2D 87.5 -> 91.7", TRAIN_MIOU, *_GRIDS, least=2.0, at_plateau=_GRIDS),
    Claim("one label map a scene: 90 % of nine", "figure", POINTS_MIOU, *_MAPS, least=0.0, factor=0.9, same_steps=True),
    Claim("views 5 -> 25", "5 -> 100: 52.2 -> 92.0", TRAIN_MIOU, *_VIEWS, least=10.0, same_steps=True),
    Claim(
        "not far below an image network", "97.1 / 92.7", TRAIN_MIOU, "nesf", "unet", least=-8.0, at_plateau=("unet",)
    ),
    Claim("the same at test cameras", "", TEST_MIOU, "nesf", "nesf", TRAIN_MIOU, least=-1.0, most=1.0),
)
