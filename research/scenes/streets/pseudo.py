"""Labels as a network that looks at one image at a time would predict them for a street: wrong by segments.

Errors follow from the seed and the frame: whole segments get a class that is easily confused with theirs, borders are
warped by some pixels, small segments are missed, and clipped areas have blobs of anything. One number, the *strength*,
scales them; bisection finds the one that gives a wanted mIoU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from research.scenes.sensor_depth import smooth_noise
from research.scenes.sequence import RoomView
from research.scenes.streets.layout import IGNORED, STREETS_CODE, STREETS_VERSION
from semantic_mapper.labels import KITTI360
from semantic_mapper.types import Float32, UInt8

MIOU, LEAST_MIOU, MOST_MIOU = 0.65, 0.62, 0.68  # of pseudo labels: wanted, and the bounds they have to keep

# What each class is taken for, and how easily.
CONFUSED: dict[str, tuple[float, tuple[str, ...]]] = {
    "road": (0.08, ("parking", "sidewalk")),
    "sidewalk": (0.3, ("road", "parking", "terrain")),
    "parking": (0.5, ("road", "sidewalk")),
    "terrain": (0.3, ("vegetation", "sidewalk")),
    "building": (0.12, ("wall", "fence")),
    "wall": (0.5, ("building", "fence", "gate")),
    "fence": (0.4, ("wall", "gate", "vegetation")),
    "gate": (0.6, ("fence", "wall", "building")),
    "vegetation": (0.12, ("terrain", "fence")),
    "car": (0.15, ("trailer", "caravan")),
    "trailer": (0.6, ("car", "caravan", "box")),
    "caravan": (0.5, ("car", "trailer", "building")),
    "box": (0.5, ("wall", "car", "gate")),
    "pole": (0.2, ("vegetation", "fence")),
    "sign": (0.2, ("building", "pole")),
}
_WARP_PX = (1.0, 3.0)  # at a width of 352
_WARPED = 3.0  # times the strength: the fraction of the warp that there is, at most all
_SMALL_PX, _MISSED = 40, 0.3  # segments smaller than this at that width, and how many of them are missed
_CLIPPED, _BLOBS = 250, 0.5  # grey level; fraction of the clipped area with blobs
_MOST, _HALVINGS = 3.0, 12  # strength, and its search
_STREAM = 6
_PIECES = 2  # a large segment is taken for something else in parts


@dataclass(frozen=True, slots=True, eq=False)
class _Draws:
    """All that is random about the labels of a frame.

    Args:
        truth: (H, W) channels.
        segment: (H, W) number of the segment, from 0.
        luck: (S,) in 0..1; a segment is taken for ``other`` where the strength times its ease exceeds it.
        other: (S,) channels.
        ease: (S,) of its class.
        missed: (S,) small segments that vanish.
        warp: (2, H, W) float32 pixels to the right and down to where each pixel's label comes from.
        blob: (H, W) channel of clipped pixels in blobs, -1 elsewhere.
    """

    truth: NDArray[np.int64]
    segment: NDArray[np.int64]
    luck: NDArray[np.float64]
    other: NDArray[np.int64]
    ease: NDArray[np.float64]
    missed: NDArray[np.bool_]
    warp: Float32
    blob: NDArray[np.int64]


def pseudo_labels(views: Sequence[RoomView], seed: int, miou: float = MIOU, every: int = 1) -> list[UInt8]:
    """Labels (H, W) of each of ``views``, ids of ``KITTI360``, of about that mIoU over every so many-th of them.

    Args:
        views: Left images of a street.
        seed: Of the street.
        miou: In 0..1.
        every: Which views it is of.
    """
    draws = [_drawn(view, seed) for view in views]
    judged = range(0, len(views), every)

    def reached(strength: float) -> float:
        return pseudo_miou([views[k] for k in judged], [_predicted(draws[k], strength) for k in judged])

    low, high = 0.0, _MOST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if reached(middle) > miou else (low, middle)
    strength = min((low, high), key=lambda s: abs(reached(s) - miou))  # a large segment that changes is a jump
    return [_predicted(d, strength) for d in draws]


def pseudo_miou(views: Sequence[RoomView], labels: Sequence[UInt8]) -> float:
    """mIoU in 0..1 over all images, of the evaluated classes that are there."""
    size = len(KITTI360)
    counts = np.zeros((size, size), np.int64)
    ignored = [KITTI360.names.index(name) for name in IGNORED]
    for view, label in zip(views, labels, strict=True):
        truth, said = KITTI360.to_channels(view.rendered.label), KITTI360.to_channels(label)
        known = (truth >= 0) & ~np.isin(truth, ignored)
        counts += np.bincount(truth[known] * size + said[known], minlength=size * size).reshape(size, size)
    hits, occurring = np.diagonal(counts), counts.sum(axis=1)
    union = occurring + counts.sum(axis=0) - hits
    return float((hits[occurring > 0] / union[occurring > 0]).mean())


def _drawn(view: RoomView, seed: int) -> _Draws:
    rng = np.random.default_rng((STREETS_CODE, STREETS_VERSION, seed, _STREAM, view.frame.seq))
    truth = KITTI360.to_channels(view.rendered.label)
    scale = truth.shape[1] / 352
    part = (_patch(truth.shape, 6 * _PIECES, rng) > 0).astype(np.int64)
    key = (truth * 65536 + view.rendered.instance.astype(np.int64) * (truth != KITTI360.names.index("road"))) * 2 + part
    segment = _connected(key)
    first = np.unique(segment, return_index=True)[1]
    own = truth.ravel()[first]
    names = [KITTI360.names[c] for c in own]
    ease = np.array([CONFUSED[n][0] if n in CONFUSED else 0.0 for n in names])
    other = own.copy()
    for k, name in enumerate(names):
        if name in CONFUSED:
            other[k] = KITTI360.names.index(str(rng.choice(CONFUSED[name][1])))
    size = np.bincount(segment.ravel())
    missed = (size < _SMALL_PX * scale**2) & (rng.random(len(size)) < _MISSED)
    amount = scale * rng.uniform(*_WARP_PX)
    warp = np.float32(amount) * np.stack([smooth_noise(truth.shape, rng) for _ in range(2)])
    clipped = (view.frame.rgb.min(axis=2) >= _CLIPPED) & (_patch(truth.shape, 12, rng) > 0)
    blob = np.where(clipped & (rng.random() < _BLOBS), int(rng.integers(len(KITTI360))), -1)
    return _Draws(truth, segment, rng.random(len(size)), other, ease, missed, warp, blob)


def _predicted(draws: _Draws, strength: float) -> UInt8:
    swapped = draws.luck < strength * draws.ease
    own = draws.truth.ravel()[np.unique(draws.segment, return_index=True)[1]]
    said = np.where(swapped, draws.other, own)[draws.segment]
    said = _filled(said, draws.missed[draws.segment])
    said = np.where(draws.blob >= 0, draws.blob, said)
    row, column = np.indices(said.shape, np.float32)
    across, down = np.float32(min(1.0, _WARPED * strength)) * draws.warp
    warped = cv2.remap(
        said.astype(np.uint8), column + across, row + down, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    return KITTI360.to_ids(np.asarray(warped, np.int64))


def _connected(key: NDArray[np.int64]) -> NDArray[np.int64]:
    """Connected areas (H, W) of one value, numbered from 0."""
    found = np.zeros(key.shape, np.int64)
    count = 0
    for value in np.unique(key):
        number, areas = cv2.connectedComponents((key == value).astype(np.uint8), connectivity=4)
        inside = areas > 0
        found[inside] = areas[inside] - 1 + count
        count += number - 1
    return found


def _filled(said: NDArray[np.int64], missing: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Labels with those of missing pixels taken from the nearest other one."""
    if not missing.any() or missing.all():
        return said
    _, nearest = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, np.int64)
    label_of = np.zeros(int(nearest.max()) + 1, np.int64)
    label_of[nearest[~missing]] = said[~missing]
    return np.where(missing, label_of[nearest], said)


def _patch(shape: tuple[int, ...], size: int, rng: np.random.Generator) -> Float32:
    """(H, W) smooth noise whose features are ``size`` pixels wide."""
    coarse = rng.standard_normal((shape[0] // size + 2, shape[1] // size + 2)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC), np.float32)
