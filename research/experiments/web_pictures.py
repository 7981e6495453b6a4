"""What a screenshot of the viewer shows, by the colours of its pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from research.experiments.browser import Browser
from semantic_mapper.plots import LegendRow
from semantic_mapper.types import UInt8

LEGEND_FROM, TOP = 0.8, 50  # the legend begins at this fraction of the width; above this row are the names of the views
IMAGES_FROM, IMAGES_TO, IMAGE_WIDTH = 0.7, 0.93, 0.2  # rows of the images, and the columns of each, as shares
MAP_TO = 0.65  # the map is above this fraction of the height
IMAGES = ("rgb", "semantics", "depth")  # from the left
LARGEST = 4  # classes that are looked for in the map; all of them in the legend
LEAST_MAP, LEAST_LEGEND = 800, 80  # pixels of each
LEAST_FILLED = 0.15  # of the map's view that is not its background
LEAST_IMAGE = 0.4  # of an image's view that is not its background


def take(browser: Browser, path: Path) -> UInt8:
    """A screenshot (H, W, 3) RGB, also written to a file."""
    data = browser.screenshot()
    path.write_bytes(data)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return np.asarray(picture[..., ::-1], np.uint8)


def what_is_missing(picture: UInt8, rows: list[LegendRow]) -> list[str]:
    """What of a map with these classes cannot be seen in a screenshot."""
    edge = round(LEGEND_FROM * picture.shape[1])
    space, legend = picture[TOP:, :edge], picture[TOP:, edge:]
    missing: list[str] = []
    filled = float((np.ptp(space.astype(np.int16), axis=2) > 24).mean())  # the background is grey
    if filled < LEAST_FILLED:
        missing.append(f"the map's view is all but empty: {filled:.1%} of it has a colour")
    for name, color, _ in rows[:LARGEST]:
        if (count := pixels_of(space, color)) < LEAST_MAP:
            missing.append(f"{name} is not seen in the map: {count} pixels")
    for name, color, _ in rows:
        if (count := pixels_of(legend, color)) < LEAST_LEGEND:
            missing.append(f"{name} is not in the legend: {count} pixels")
    return missing


def map_pixels(picture: UInt8) -> int:
    """Pixels of the map's view of a live system that have a colour."""
    height, width = picture.shape[:2]
    space = picture[TOP : round(MAP_TO * height), : round(LEGEND_FROM * width)]
    return int((np.ptp(space.astype(np.int16), axis=2) > 24).sum())


def empty_images(picture: UInt8) -> list[str]:
    """Which of the camera's images cannot be seen in a screenshot of a live system."""
    height, width = picture.shape[:2]
    band = picture[round(IMAGES_FROM * height) : round(IMAGES_TO * height)].max(axis=2) > 48  # the background is darker
    missing: list[str] = []
    for i, name in enumerate(IMAGES):
        view = band[:, round(i * IMAGE_WIDTH * width) : round((i + 1) * IMAGE_WIDTH * width)]
        if (seen := float(view.mean())) < LEAST_IMAGE:
            missing.append(f"camera: {name} is all but empty: {seen:.1%} of it is not dark")
    return missing


def pixels_of(picture: UInt8, color: tuple[int, int, int]) -> int:
    """Pixels of a colour, or of one that shading has made darker."""
    seen, wanted = picture.astype(np.float32), np.array(color, np.float32)
    length = np.linalg.norm(seen, axis=2)
    along = seen @ wanted / np.linalg.norm(wanted)
    return int(((length > 0.5 * np.linalg.norm(wanted)) & (along > 0.996 * length)).sum())
