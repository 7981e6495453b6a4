"""Features of the picked frames, which of those frames show the same place again, and which features are the same."""

from __future__ import annotations

import cv2
import numpy as np
import scipy  # loads `cluster` when it is first used
from numpy.typing import NDArray

from semantic_mapper.types import Float32, Float64, UInt8

MOST_FEATURES = 2500
_CONTRAST = 0.02  # half of OpenCV's default: walls of rooms have little
WORDS, TRAIN_ROWS, ROUNDS = 32, 20_000, 8  # of the vocabulary that the film's own features make
LOOPS_A_FRAME = 3
MAX_ANGLE, MAX_ANGLE_RATIO = 0.7, 0.8  # radians between two descriptors of one thing, and of the angle to the second
MIN_SIMILARITY = 0.15  # of two frames that may show the same place; of two any frames it is about 0


def find_features(bgr: UInt8) -> tuple[Float32, UInt8]:
    """SIFT's pixels (N, 2) float32, centres of pixels being integers, and descriptors (N, 128) uint8 (square roots)."""
    sift = cv2.SIFT.create(nfeatures=MOST_FEATURES, contrastThreshold=_CONTRAST)
    keypoints, found = sift.detectAndCompute(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), None)
    if found is None or not len(keypoints):
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    xy = np.array([k.pt for k in keypoints], np.float32)[:MOST_FEATURES]
    rows = np.asarray(found, np.float32)[:MOST_FEATURES]
    rooted = np.sqrt(rows / np.maximum(rows.sum(axis=1, keepdims=True), 1e-9))
    return xy, np.clip(np.round(512 * rooted), 0, 255).astype(np.uint8)


def match_features(a: UInt8, b: UInt8) -> NDArray[np.uint32]:
    """Rows (M, 2) of features (N, 128) that are each other's nearest, by angle, and clearly nearer than the second one.

    Every feature is compared with every other one: COLMAP's search through an index differs now and then between runs.
    Products of bytes are whole numbers below 2^24, so that the outcome is the same on any number of threads.
    """
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.uint32)
    alike = a.astype(np.float32) @ b.astype(np.float32).T
    best = alike.argmax(axis=1)
    rows = np.flatnonzero(alike.argmax(axis=0)[best] == np.arange(len(a)))
    pairs = rows, best[rows]
    near = alike[pairs]
    alike[pairs] = -1  # what is left is the second nearest
    second = np.maximum(alike[rows].max(axis=1), alike[:, best[rows]].max(axis=0))
    angle, next_angle = (np.arccos(np.minimum(x / 512.0**2, 1.0)) for x in (near, second))
    good = (angle < MAX_ANGLE) & (angle < MAX_ANGLE_RATIO * next_angle)
    return np.stack((pairs[0][good], pairs[1][good]), axis=1).astype(np.uint32)


def loop_pairs(descriptors: list[UInt8], window: int, seed: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of frames further than ``window`` apart that look alike, by their descriptors (N, 128).

    Frames are compared by the sums of their descriptors' residuals to a few words (VLAD), learned from all of them.
    """
    filled = [rows for rows in descriptors if len(rows)]
    if len(filled) <= window or sum(map(len, filled)) < 10 * WORDS:
        return []
    rng = np.random.default_rng(seed)
    each = max(1, TRAIN_ROWS // len(filled))
    sample = np.concatenate([rows[rng.permutation(len(rows))[:each]] for rows in filled]).astype(np.float64)
    words, _ = scipy.cluster.vq.kmeans2(sample, WORDS, ROUNDS, minit="points", rng=rng)
    signatures = np.stack([_signature(rows.astype(np.float64), words) for rows in descriptors])
    signatures -= signatures.mean(axis=0)
    signatures /= np.maximum(np.linalg.norm(signatures, axis=1, keepdims=True), 1e-9)
    alike = signatures @ signatures.T
    gap = np.abs(np.subtract.outer(np.arange(len(alike)), np.arange(len(alike))))
    alike[gap <= window] = -1
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(alike):
        best = np.argsort(-row, kind="stable")[:LOOPS_A_FRAME]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] > MIN_SIMILARITY}
    return sorted(pairs)


def _signature(rows: Float64, words: Float64) -> Float64:
    sums = np.zeros_like(words)
    if len(rows):
        nearest, _ = scipy.cluster.vq.vq(rows, words)
        np.add.at(sums, nearest, rows - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9)
