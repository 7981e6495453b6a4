"""Views of a board: found in images, those kept that say something new, and what they still lack, in words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np

from semantic_mapper.config import Config, Positive
from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibration import guess_intrinsics
from semantic_mapper.drivers.poses.board import BoardFinder, board_poses
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import CameraError
from semantic_mapper.types import CameraIntrinsics, Float64

NEW = 0.08  # least distance of a view from those kept; see ``_signature``
MIN_CORNERS = 8  # seen, for an image to be used
MAX_VIEWS = 60  # those beyond say nothing new
MIN_TILT_DEG = 15.0  # the board leans so far at least once, both up or down and to a side
STEADY_PX = 1.5  # streams: further than this a corner moves only while the board is not held still
MAX_APART_NS = 20_000_000  # images of two cameras so far apart in time count as taken at once
CELLS = 6  # a side; the image is divided into this many cells
REGIONS = ("top left", "top", "top right", "left", "middle", "right", "bottom left", "bottom", "bottom right")
_ACROSS = 3  # regions a side
_SEEN_CELLS = 2  # of the four of a region that must have corners in them
FLAT = 0.05  # corners whose spread across their main line is below this fraction of it are on a line


class CalibrationConfig(Config, frozen=True):
    """The lens model, and what a result has to be like to be written."""

    coefficients: Literal[4, 5, 8] = 5  # of lens distortion; 8 for wide angles, 4 where few images are to be had
    min_views: Annotated[int, msgspec.Meta(ge=4)] = 10
    max_error_px: Positive = 1.0  # RMS reprojection error of the whole


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The corners of the board in one image."""

    name: str  # of the image, for people
    stamp_ns: int  # when it was taken
    points: Float64  # (N, 3) on the board, metres
    pixels: Float64  # (N, 2) in the image as the lens gives it


class ViewGatherer:
    """Takes the images of one camera and keeps what calibration needs of them.

    With ``stream`` images follow each other closely: those that moved since the one before are left out.
    """

    def __init__(self, board: BoardPoses, config: CalibrationConfig, *, stream: bool) -> None:
        self._finder = BoardFinder(board)
        self._config = config
        self._stream = stream
        self._last: BoardView | None = None
        self._signatures: list[Float64] = []  # of the views that are kept
        self.images = self.seen = 0  # how many were looked at, and in how many the board was
        self.kept: list[BoardView] = []  # for the intrinsics, each unlike the others
        self.steady: list[BoardView] = []  # all in which the board stood still
        self.size: tuple[int, int] | None = None  # width and height of the images
        self.intrinsics: CameraIntrinsics | None = None  # what the source says of them

    def take(self, image: CameraImage, name: str = "") -> bool:
        """Look at an image; whether its view was kept. ``CameraError``: images of two sizes."""
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
        spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False) if len(points) >= MIN_CORNERS else (0, 0)
        if spread[1] <= FLAT * spread[0]:  # too few, or on a line
            return False
        self.seen += 1
        view = self._last = BoardView(name or f"image {image.seq}", image.stamp_ns, points, pixels)
        if self._stream and not _stands_still(before, view):
            return False
        self.steady.append(view)
        found = _signature(view, size) if len(self.kept) < MAX_VIEWS else None
        if found is None or any(np.linalg.norm(found - other) < NEW for other in self._signatures):
            return False
        self._signatures.append(found)
        self.kept.append(view)
        return True

    def lacks(self) -> list[str]:
        """What the kept views lack for a calibration, as sentences; empty where they may do."""
        if self.size is None:
            return ["no image has come yet"]
        tilts = np.degrees(np.reshape(self._signatures, (-1, 5))[:, 3:])
        return shortfalls(self._config, len(self.kept), area_counts(self.kept, self.size), tilts)


def simultaneous(views: Mapping[str, Sequence[BoardView]]) -> list[dict[str, BoardView]]:
    """Views of several cameras, grouped by when they were taken: at least two cameras each, evenly thinned out."""
    events = sorted(((v.stamp_ns, name, v) for name, own in views.items() for v in own), key=lambda e: e[:2])
    groups: list[dict[str, BoardView]] = []
    began_ns = 0
    for stamp_ns, name, view in events:
        if not groups or stamp_ns - began_ns > MAX_APART_NS or name in groups[-1]:
            groups.append({})
            began_ns = stamp_ns
        groups[-1][name] = view
    shared = [group for group in groups if len(group) > 1]
    chosen = np.linspace(0, len(shared) - 1, min(len(shared), MAX_VIEWS)).round()
    return [shared[int(i)] for i in chosen]


def area_counts(views: Sequence[BoardView], size: tuple[int, int]) -> Float64:
    """Corners in each cell of the image, (CELLS, CELLS)."""
    u, v = np.concatenate([np.zeros((0, 2)), *(view.pixels for view in views)]).T + 0.5
    return np.histogram2d(v, u, CELLS, ((0, size[1]), (0, size[0])))[0]


def missing_regions(counts: Float64) -> list[str]:
    """Names of the ninths of the image in which the board was not seen, or hardly."""
    side = CELLS // _ACROSS
    seen = (counts > 0).reshape(_ACROSS, side, _ACROSS, side).sum(axis=(1, 3)).ravel()
    return [name for name, cells in zip(REGIONS, seen, strict=True) if cells < _SEEN_CELLS]


def tilt_radians(T_camera_board: Float64) -> Float64:
    """How far the board leans, (2,): up or down, and to a side; (0, 0) where it is seen head on."""
    x, y, z = T_camera_board[:3, 2]
    return np.array((np.arctan2(y, z), np.arctan2(x, z)))


def shortfalls(config: CalibrationConfig, views: int, counts: Float64, tilts: Float64 | None) -> list[str]:
    """What ``views`` views lack for a calibration that can be believed, as sentences that say what to do.

    ``counts`` are those of ``area_counts``; ``tilts`` (N, 2) degrees, None where they are not known yet.
    """
    lacks: list[str] = []
    if views < config.min_views:
        lacks.append(f"{views} views that differ from each other, {config.min_views} are needed: move the board about")
    if missing := missing_regions(counts):
        lacks.append(f"the board was not seen in these parts of the image: {', '.join(missing)}; hold it there, too")
    if tilts is None:
        return lacks
    steepest = np.abs(tilts).max(axis=0, initial=0)
    for name, most in zip(("up or down", "to the left or right"), steepest, strict=True):
        if most < MIN_TILT_DEG:
            lacks.append(
                f"the board never leaned {name} by {MIN_TILT_DEG:g} degrees (at most {most:.0f}); without that "
                "the focal length cannot be distinguished from the distance"
            )
    return lacks


def _stands_still(before: BoardView | None, view: BoardView) -> bool:
    """Whether the corners that both show are where they were."""
    if before is None:
        return False
    ours, theirs = np.nonzero((view.points[:, None] == before.points[None]).all(axis=-1))
    moves = np.linalg.norm(view.pixels[ours] - before.pixels[theirs], axis=1)
    return len(moves) > 0 and float(np.median(moves)) <= STEADY_PX


def _signature(view: BoardView, size: tuple[int, int]) -> Float64 | None:
    """What a view is like (5,): where in the image (2), how large, and how it leans (2, radians).

    How it leans comes of a guessed focal length; that is good enough to tell views apart.
    """
    found = board_poses(view.points, view.pixels, guess_intrinsics(*size))
    if not found:
        return None
    hull = cv2.convexHull(view.pixels.astype(np.float32))
    large = np.sqrt(cv2.contourArea(hull) / (size[0] * size[1]))
    return np.array((*(view.pixels.mean(axis=0) / size), large, *tilt_radians(found[0][1])))
