"""Films, calibrations and patience for tests of cameras."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np

PATIENCE_S = 20.0


def until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline, "did not come true"
        time.sleep(0.005)


def write_calibration(path: Path, width: int = 64, height: int = 48) -> str:
    path.write_text(
        f"fx = 60.0\nfy = 60.0\ncx = {(width - 1) / 2}\ncy = {(height - 1) / 2}\nwidth = {width}\nheight = {height}\n"
    )
    return str(path)


def write_film(path: Path, images: Iterable[np.ndarray], hz: float = 10, codec: str = "MJPG") -> Path:
    """Of images (H, W, 3) RGB."""
    images = list(images)
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), hz, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    return path
