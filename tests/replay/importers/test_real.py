"""Frames of the real samples fit each other: what two of them see of one place lies on one line by their poses."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.geometry import camera_matrix, invert_pose
from semantic_mapper.replay.importers import ImportOptions, import_recording
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.types import Float64, PosedFrame

FITS_PX = 4.0


def epipolar_distances(a: PosedFrame, b: PosedFrame) -> Float64:
    """Pixels (N,) between matched features of ``b`` and the lines on which those of ``a`` have to lie."""
    sift, found = cv2.SIFT.create(1000), []
    for frame in (a, b):
        found.append(sift.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), None))  # type: ignore[call-overload]
    (points_a, words_a), (points_b, words_b) = found
    pairs = [m for m, n in cv2.BFMatcher().knnMatch(words_a, words_b, k=2) if m.distance < 0.7 * n.distance]
    p = np.array([(*points_a[m.queryIdx].pt, 1.0) for m in pairs])
    q = np.array([(*points_b[m.trainIdx].pt, 1.0) for m in pairs])
    T_b_a = invert_pose(b.T_world_camera) @ a.T_world_camera
    x, y, z = T_b_a[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T_b_a[:3, :3]
    F = np.linalg.inv(camera_matrix(b.intrinsics)).T @ E @ np.linalg.inv(camera_matrix(a.intrinsics))
    lines = p @ F.T
    return np.abs((lines * q).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)


def frames_of(folder: Path, log: Path, count: int) -> list[PosedFrame]:
    import_recording(folder, log, options=ImportOptions(max_frames=count))
    with LogReader(log) as reader:
        return list(reader)


def test_frames_of_the_kitchen_fit(redkitchen: Path, tmp_path: Path) -> None:
    frames = frames_of(redkitchen, tmp_path / "log.mcap", 16)
    off = [np.median(epipolar_distances(a, b)) for a, b in zip(frames[:12:3], frames[4::3], strict=False)]
    assert max(off) < FITS_PX


def test_frames_of_the_apartment_fit(adt_apartment: Path, tmp_path: Path) -> None:
    frames = frames_of(adt_apartment, tmp_path / "log.mcap", 6)
    moved = [np.linalg.norm(b.T_world_camera[:3, 3] - a.T_world_camera[:3, 3]) for a, b in pairwise(frames)]
    a = int(np.argsort(moved)[len(moved) // 2])
    distances = epipolar_distances(frames[a], frames[a + 1])
    assert len(distances) >= 8 and np.median(distances) < FITS_PX
