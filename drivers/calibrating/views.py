"""Views of a board: found in images, and those kept that say something new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.coverage import area_counts, shortfalls, tilt_degrees
from semantic_mapper.drivers.calibration import guess_intrinsics
from semantic_mapper.drivers.poses.board import BoardFinder, board_poses, pose_of_vector
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import CameraError
from semantic_mapper.types import CameraIntrinsics, Float64

NEW = 0.08  # least distance of a view from those kept; see ``_signature``
FLAT = 0.05  # corners whose spread across their main line is below this fraction of it are on a line


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The corners of the board in one image.

    Args:
        name: Of the image, for people.
        stamp_ns: When it was taken.
        points: (N, 3) on the board, metres.
        pixels: (N, 2) in the image as the lens gives it.
    """

    name: str
    stamp_ns: int
    points: Float64
    pixels: Float64


class ViewGatherer:
    """Takes the images of one camera and keeps what calibration needs of them.

    Args:
        board: To look for.
        config: What makes a view worth keeping.
        stream: Images follow each other closely: those that moved since the one before are left out.

    Attributes:
        images: How many were looked at; ``seen``: in how many the board was.
        kept: Views for the intrinsics, each unlike the others.
        steady: All views in which the board stood still.
        size: (width, height) of the images; intrinsics: what the source says of them. None before the first.
    """

    def __init__(self, board: BoardPoses, config: CalibrationConfig, *, stream: bool) -> None:
        self._finder = BoardFinder(board)
        self._config = config
        self._stream = stream
        self._last: BoardView | None = None
        self._signatures: list[Float64] = []
        self._tilts: list[Float64] = []
        self.images = self.seen = 0
        self.kept: list[BoardView] = []
        self.steady: list[BoardView] = []
        self.size: tuple[int, int] | None = None
        self.intrinsics: CameraIntrinsics | None = None

    def take(self, image: CameraImage, name: str = "") -> bool:
        """Look at an image; whether its view was kept.

        Raises:
            CameraError: images of two sizes.
        """
        size = (image.intrinsics.width, image.intrinsics.height)
        if self.size not in (None, size):
            raise CameraError(
                f"camera '{image.camera_id}': an image of {size[0]}x{size[1]} among those of {self.size}; calibrate "
                "with images of one size, that in which the camera is used"
            )
        self.size, self.intrinsics = size, image.intrinsics
        self.images += 1
        points, pixels = self._finder.find(image.rgb)
        before, self._last = self._last, None
        if len(points) < self._config.min_corners or _on_a_line(pixels):
            return False
        self.seen += 1
        view = self._last = BoardView(name or f"image {image.seq}", image.stamp_ns, points, pixels)
        if self._stream and self._config.steady_px and not _stands_still(before, view, self._config.steady_px):
            return False
        self.steady.append(view)
        return self._keep(view, size)

    def lacks(self) -> tuple[str, ...]:
        """What the kept views lack for a calibration, as sentences; empty where they may do."""
        if self.size is None:
            return ("no image has come yet",)
        tilts = np.array(self._tilts).reshape(-1, 2)
        return shortfalls(self._config, len(self.kept), area_counts([v.pixels for v in self.kept], self.size), tilts)

    def _keep(self, view: BoardView, size: tuple[int, int]) -> bool:
        if len(self.kept) >= self._config.max_views:
            return False
        found = _signature(view, size)
        if found is None:
            return False
        signature, tilt = found
        if any(np.linalg.norm(signature - other) < NEW for other in self._signatures):
            return False
        self._signatures.append(signature)
        self._tilts.append(tilt)
        self.kept.append(view)
        return True


def simultaneous(views: Mapping[str, Sequence[BoardView]], config: CalibrationConfig) -> list[dict[str, BoardView]]:
    """Views of several cameras, grouped by when they were taken: at least two cameras each, evenly thinned out."""
    apart_ns = round(config.max_apart_s * 1e9)
    events = sorted(((v.stamp_ns, name, v) for name, own in views.items() for v in own), key=lambda e: e[:2])
    groups: list[dict[str, BoardView]] = []
    began_ns = 0
    for stamp_ns, name, view in events:
        if not groups or stamp_ns - began_ns > apart_ns or name in groups[-1]:
            groups.append({})
            began_ns = stamp_ns
        groups[-1][name] = view
    shared = [group for group in groups if len(group) > 1]
    if len(shared) <= config.max_views:
        return shared
    return [shared[int(i)] for i in np.linspace(0, len(shared) - 1, config.max_views).round()]


def _on_a_line(pixels: Float64) -> bool:
    spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)
    return bool(spread[1] < FLAT * spread[0])


def _stands_still(before: BoardView | None, view: BoardView, limit_px: float) -> bool:
    """Whether the corners that both show are where they were."""
    if before is None:
        return False
    known = {tuple(point): pixel for point, pixel in zip(before.points.tolist(), before.pixels, strict=True)}
    moves = [
        float(np.linalg.norm(pixel - known[tuple(point)]))
        for point, pixel in zip(view.points.tolist(), view.pixels, strict=True)
        if tuple(point) in known
    ]
    return bool(moves) and float(np.median(moves)) <= limit_px


def _signature(view: BoardView, size: tuple[int, int]) -> tuple[Float64, Float64] | None:
    """What a view is like: where in the image, how large, how it leans (5,); and its tilt in degrees (2,).

    The tilt comes of a guessed focal length; that is good enough to tell views apart.
    """
    found = board_poses(view.points, view.pixels, guess_intrinsics(*size))
    if not found:
        return None
    tilt = tilt_degrees(pose_of_vector(found[0][1]))
    middle = view.pixels.mean(axis=0) / size
    hull = cv2.convexHull(view.pixels.astype(np.float32))
    large = float(np.sqrt(cv2.contourArea(hull) / (size[0] * size[1])))
    return np.array((*middle, large, *np.deg2rad(tilt))), tilt
