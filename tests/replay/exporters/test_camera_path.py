"""The way of a camera that runs for days."""

from __future__ import annotations

import numpy as np

from semantic_mapper.replay.exporters.camera_path import MAX_PATH, CameraPath


def test_the_path_of_a_camera_stays_bounded_and_even() -> None:
    path = CameraPath()
    for number in range(3 * MAX_PATH):
        T = np.eye(4)
        T[0, 3] = number
        path.add(T)
    kept = [T[0, 3] for T in path.poses]
    assert len(kept) <= MAX_PATH and set(np.diff(kept)) == {4.0} and kept[0] == 0
