"""What importers of posed picture collections share: OpenGL axes, lenses that are undone, depth of another size, and
where models of structure from motion lie, whose unit and axes are their own: by GPS, or upright by the cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import cv2
import msgspec
import numpy as np

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ConfigError, ImportSourceError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    check_frame_pose,
    inside,
    numpy_notice,
    read_depth,
    read_plane,
    read_rgb,
    same_view,
)
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, place_by_gps, read_position
from semantic_mapper.replay.sfm.scale import UNSCALED_DEPTH_M, scene_depth, upright
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

KEPT_RECTIFIERS = 8  # of some megabytes each
SHIFT_NS = 1_000_000  # between pictures of one time
DEFAULT_HZ = 2.0  # at which pictures without times count as taken
T_Z_UP_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # of ARKit's world frame
GL_AXES = np.diag((1.0, -1.0, -1.0, 1.0))  # T_gl_cv: OpenGL's cameras look along -z, with y up


@dataclass(frozen=True, slots=True, eq=False)
class PosedPicture:
    """One picture of a collection.

    Args:
        file: The picture.
        intrinsics: With distortion, as the collection gives them.
        T_world_camera: (4, 4), OpenCV's axes.
        depth_file: 16-bit PNG or NumPy's file, of any size with the same view; None = no depth.
        stamp_ns: None = not known.
        confidence_file: 8-bit PNG of the depth image's size, whose 0 means that the depth is not to be trusted.
    """

    file: Path
    intrinsics: CameraIntrinsics
    T_world_camera: Float64
    depth_file: Path | None = None
    stamp_ns: int | None = None
    confidence_file: Path | None = None


class PosedPictures:
    """A collection as a ``Recording``.

    Args:
        source: What it is, for people.
        pictures: In their order; where each has a time, in that of the times.
        options: See ``ImportOptions``; ``scale`` makes metres of a collection's own unit.
        depth_scale: Of its depth images.
        metric: Whether its lengths are metres.

    Raises:
        ImportSourceError: it holds no picture.
    """

    def __init__(
        self,
        source: str,
        folder: Path,
        pictures: Sequence[PosedPicture],
        options: ImportOptions,
        *,
        depth_scale: DepthScale,
        metric: bool,
    ) -> None:
        if not pictures:
            raise ImportSourceError(f"{folder}: holds no posed picture")
        self.notices: list[str] = []
        self._options = options
        self._hz = options.frame_hz or DEFAULT_HZ
        self._pictures, self._stamps_ns = _in_time(_once_each(pictures, self.notices), self._hz, self.notices)
        self._factor = options.scale or 1.0
        self._rectifiers: dict[CameraIntrinsics, Rectifier] = {}
        self.depth_scale = depth_scale
        metric = metric or options.scale is not None
        if not metric:
            self.notices.append(
                "the scale is unknown: lengths of the log are not metres; give --scale, metres per unit of the poses"
            )
        named = [picture.depth_file for picture in self._pictures if picture.depth_file is not None]
        missing = [] if options.without_depth else [file for file in named if not file.exists()]
        if missing:
            self.notices.append(f"{len(missing)} of {len(named)} depth images are missing; the first: {missing[0]}")
        if not options.without_depth:
            self.notices += numpy_notice(named, depth_scale)
        first = self._rectifier(self._pictures[0].intrinsics, self._pictures[0].file)
        self.info = StreamInfo(
            source=f"{source} {folder.resolve().name}",
            cameras={options.camera_id: first.intrinsics},
            frame_count=len(self._pictures),
            frame_hz=self._hz,
            metadata={} if metric else {SCALE_KEY: SCALE_UNKNOWN},
        )

    def __len__(self) -> int:
        return len(self._pictures)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        picture = self._pictures[number]
        rgb, encoded = read_rgb(picture.file)
        height, width = rgb.shape[:2]
        given = picture.intrinsics
        if (given.width, given.height) != (width, height):
            if not same_view((given.width, given.height), (width, height)):
                raise BadFrameError(
                    picture.file, f"the picture is {width}x{height}, its camera {given.width}x{given.height}"
                )
            given = scale_intrinsics(given, width, height)
        rectifier = self._rectifier(given, picture.file)
        changed = given.distorted
        pose = picture.T_world_camera.copy()
        pose[:3, 3] *= self._factor
        frame = PosedFrame(
            stamp_ns=self._stamps_ns[number],
            seq=number,
            camera_id=self._options.camera_id,
            rgb=rectifier(np.ascontiguousarray(rgb[..., ::-1])) if changed else rgb,
            depth_m=self._depth(picture, rectifier, (height, width)),
            label=None,
            intrinsics=rectifier.intrinsics,
            T_world_camera=check_frame_pose(pose, picture.file),
        )
        return LoadedFrame(frame, None if changed else encoded)

    def _depth(self, picture: PosedPicture, rectifier: Rectifier, size: tuple[int, int]) -> Float32 | None:
        """Depth image (H, W) in metres, of the size and the lens of the picture; None without depth."""
        if picture.depth_file is None or self._options.without_depth or not picture.depth_file.exists():
            return None
        depth_m = read_depth(picture.depth_file, self.depth_scale, None)
        if picture.confidence_file is not None and picture.confidence_file.exists():
            of = (depth_m.shape[0], depth_m.shape[1])
            depth_m[read_plane(picture.confidence_file, "uint8", of, "confidence") == 0] = 0
        if not same_view((depth_m.shape[0], depth_m.shape[1]), size):
            raise BadFrameError(
                picture.depth_file,
                f"the depth image is {depth_m.shape[1]}x{depth_m.shape[0]}, its picture {size[1]}x{size[0]}, which is "
                "another form: register depth to the picture, or import without it (--topic depth=none)",
            )
        if depth_m.shape != size:
            depth_m = np.asarray(cv2.resize(depth_m, size[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
        return rectifier.nearest(depth_m)

    def _rectifier(self, intrinsics: CameraIntrinsics, file: Path) -> Rectifier:
        if intrinsics not in self._rectifiers:
            if len(self._rectifiers) >= KEPT_RECTIFIERS:  # cameras with a lens a picture have as many as pictures
                self._rectifiers.pop(next(iter(self._rectifiers)))
            try:
                self._rectifiers[intrinsics] = Rectifier(intrinsics)
            except ConfigError as error:
                raise BadFrameError(file, str(error)) from error
        return self._rectifiers[intrinsics]


def _once_each(pictures: Sequence[PosedPicture], notices: list[str]) -> list[PosedPicture]:
    """The pictures without those that are there before, and a sentence on what is odd about their order."""
    first = {picture.file: picture for picture in reversed(pictures)}
    kept = [picture for picture in pictures if first[picture.file] is picture]
    if len(kept) < len(pictures):
        again = next(picture.file for picture in pictures if first[picture.file] is not picture)
        notices.append(
            f"{len(pictures) - len(kept)} pictures are there twice; of each the first pose counts; the first: {again}"
        )
    return kept


def _in_time(pictures: Sequence[PosedPicture], hz: float, notices: list[str]) -> tuple[list[PosedPicture], list[int]]:
    """The pictures in the order of their times and their stamps, which are made up where not each has a time."""
    timed = [(picture.stamp_ns, picture) for picture in pictures if picture.stamp_ns is not None]
    if len(timed) < len(pictures):
        why = (
            f"{len(pictures) - len(timed)} of {len(pictures)} pictures have no time" if timed else "there are no times"
        )
        notices.append(f"{why}: stamps are made up at {hz:g} frames a second")
        return list(pictures), [round(number * 1e9 / hz) for number in range(len(pictures))]
    if any(a > b for (a, _), (b, _) in pairwise(timed)):
        notices.append("the times of the pictures go back; pictures are sorted by them")
        timed.sort(key=lambda pair: pair[0])
    stamps_ns: list[int] = []
    for stamp_ns, _ in timed:
        stamps_ns.append(max(stamp_ns, stamps_ns[-1] + SHIFT_NS) if stamps_ns else stamp_ns)
    shifted = sum(mine != given for mine, (given, _) in zip(stamps_ns, timed, strict=True))
    if shifted:
        notices.append(f"{counted(shifted, 'picture')} with the time of another one; stamps are put behind it by 1 ms")
    return [picture for _, picture in timed], stamps_ns


@dataclass(frozen=True, slots=True, eq=False)
class PosedModel:
    """A model in the world of a log.

    Args:
        poses: (N, 4, 4) T_world_camera.
        metric: Whether lengths are metres, but for a scale that is given.
        notices: What is to be said of it.
        metadata: Of the log.
    """

    poses: Float64
    metric: bool
    notices: list[str] = field(default_factory=list[str])
    metadata: dict[str, str] = field(default_factory=dict[str, str])

    def pictures(
        self, source: str, folder: Path, pictures: list[PosedPicture], options: ImportOptions
    ) -> PosedPictures:
        """The recording, once its pictures, posed as in the model, are moved."""
        moved = [replace(picture, T_world_camera=T) for picture, T in zip(pictures, self.poses, strict=True)]
        scale = DepthScale(1000.0, convention=f"a model of {source} has no depth images")
        opened = PosedPictures(source, folder, moved, options, depth_scale=scale, metric=self.metric)
        opened.notices += self.notices
        opened.info = msgspec.structs.replace(opened.info, metadata={**opened.info.metadata, **self.metadata})
        return opened


def has_picture(root: Path, name: str) -> bool:
    """Whether a model's picture is in this folder; one whose name leads out of it, or cannot be one, is not."""
    try:
        return inside(root, name).is_file()
    except (ImportSourceError, OSError):
        return False


def place_model(
    poses: Float64, pictures: list[PosedPicture], options: ImportOptions, depth: Callable[[], float]
) -> PosedModel:
    """Place a model by the positions of its pictures if they have some and no scale is given, else upright.

    Args:
        poses: (N, 4, 4) T_model_camera.
        pictures: Theirs.
        options: Of the import.
        depth: Tells the median depth of the model's points; 0 = it has none.
    """
    notices: list[str] = []
    median = depth()
    if options.scale is None:
        try:
            fit = place_by_gps(poses, [read_position(picture.file) for picture in pictures])
        except ImportSourceError as error:
            notices.append(f"GPS is not used: {error}")
        else:
            if fit is not None:
                said = [f"scale, up and north: {fit}"]
                moved = np.stack([fit.moved(pose) for pose in poses])
                return PosedModel(moved, True, said, {ORIGIN_KEY: str(fit.origin), **scene_depth(fit.scale * median)})
    posed = upright(poses[0], camera_up(poses)) @ poses
    if options.scale is not None:
        return PosedModel(posed, False, notices, scene_depth(options.scale * median))
    posed[:, :3, 3] *= UNSCALED_DEPTH_M / median if median > 0 else 1.0
    return PosedModel(posed, False, notices)
