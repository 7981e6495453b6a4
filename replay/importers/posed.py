"""The reader that all formats of files fill in: posed pictures, with depth, labels, lenses and times."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ConfigError, ImportSourceError, LabelError
from semantic_mapper.geometry import camera_matrix, scale_intrinsics
from semantic_mapper.imaging import resize_frame, rotate_frame, rotate_intrinsics, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    CAMERA_ID,
    BadFrameError,
    DepthScale,
    ImportOptions,
    check_frame_pose,
    read_depth,
    read_label,
    read_plane,
    read_rgb,
    same_view,
)
from semantic_mapper.replay.importers.tables import left_out_notice
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import encode_rgb
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

JPEG_QUALITY = 95  # of pictures that were JPEG files and are made smaller
KEPT_RECTIFIERS = 8  # of some megabytes each
SHIFT_NS = 1_000_000  # between pictures of one time
DEFAULT_HZ = 2.0  # at which pictures without times count as taken
T_Z_UP_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # of ARKit's world frame
GL_AXES = np.diag((1.0, -1.0, -1.0, 1.0))  # T_gl_cv: OpenGL's cameras look along -z, with y up


@dataclass(frozen=True, slots=True, eq=False)
class PosedPicture:
    """One picture of a recording."""

    file: Path
    intrinsics: CameraIntrinsics  # with distortion, of the picture at any size
    pose: Float64 | BadFrameError  # T_world_camera (4, 4), OpenCV's axes; or why the picture cannot be used
    stamp_ns: int | BadFrameError | None = None  # None = not known; or why the picture cannot be used
    depth_file: Path | None = None  # 16-bit PNG or NumPy's file, of any size with the same view
    confidence_file: Path | None = None  # 8-bit PNG of its size, whose 0 means that the depth is not to be trusted
    sigma_file: Path | None = None  # the depth is computed, and this is its one-sigma spread
    label_file: Path | None = None  # 8-bit PNG of the picture's size
    pseudo_label: bool = False  # weights have rendered the label image
    view: CameraIntrinsics | None = None  # a camera at the same place, to whose pixels, as depth has, all is brought
    seq: int | None = None  # number of the frame in the log; None = its place in the recording
    camera_id: str = CAMERA_ID  # in the log

    @property
    def fault(self) -> BadFrameError | None:
        """Why it cannot be used."""
        return next((found for found in (self.pose, self.stamp_ns) if isinstance(found, BadFrameError)), None)


@dataclass(frozen=True, slots=True)
class LoadedFrame:
    """One frame of a recording."""

    frame: PosedFrame  # ready for the log
    encoded_rgb: EncodedImage | None  # its colour image as the file holds it; None where it had to be changed
    label_error: BadFrameError | None = None  # why it has no label image although there is a file


class PosedPictures:
    """The pictures of a recording, in the order of their times where each has one; ``load`` may be called in any order.

    ``scale_from`` says what gives metres, where an error of it would scale the map; or it is ``SCALE_UNKNOWN``.
    ``read_depth`` reads depth in metres and in the pixels of the rectified picture; by default it goes by
    ``depth_scale``, where the file is there. ``read_rgb`` and ``read_label`` are as those of ``base``. Raises
    ImportSourceError: there is no picture. LabelError: a class to rename that the recording does not have.
    """

    def __init__(
        self,
        source: str,
        pictures: Sequence[PosedPicture],
        options: ImportOptions,
        depth_scale: DepthScale,
        notices: Sequence[str],
        *,
        scale_from: str = "",
        hz: float = DEFAULT_HZ,
        labels: LabelSet | None = None,
        read_rgb: Callable[[Path], tuple[UInt8, EncodedImage | None]] = read_rgb,
        read_depth: Callable[[PosedPicture, Rectifier], Float32] | None = None,
        read_label: Callable[[Path, LabelSet, tuple[int, int]], UInt8] = read_label,
    ) -> None:
        if not pictures:
            raise ImportSourceError("; ".join((f"{source}: holds no posed picture", *notices)))
        self.notices = list(notices)
        self.depth_scale = depth_scale
        self._with_depth = not options.without_depth
        self._read_rgb, self._read_depth, self._read_label = read_rgb, read_depth, read_label
        self._pictures, self._stamps_ns = _in_time(_once_each(pictures, self.notices), hz, self.notices)
        self._factor = options.scale or 1.0
        self._rectifiers = lru_cache(KEPT_RECTIFIERS)(Rectifier)  # a picture may have a lens of its own
        if options.scale is not None:
            scale_from = f"the stated {options.scale:g} m per unit"
        elif scale_from == SCALE_UNKNOWN:
            self.notices.append(
                "the scale is unknown: lengths of the log are not metres; give --scale, metres per unit of the poses"
            )
        named = [picture.depth_file for picture in self._pictures if picture.depth_file is not None]
        missing = [str(file) for file in named if not file.exists()] if self._with_depth and read_depth is None else []
        self.notices += left_out_notice("depth image", missing, "missing")
        cameras = {
            picture.camera_id: self._rectifier(picture.view or picture.intrinsics, picture.file).intrinsics
            for picture in {picture.camera_id: picture for picture in reversed(self._pictures)}.values()
        }
        self._labels, self._new_ids = labels, np.arange(256, dtype=np.uint8)
        if options.renames:
            if labels is None:
                raise LabelError(f"{source}: there are no classes to rename, it has no labels")
            labels, self._new_ids = labels.renamed(options.renames)
        self._quarters, self._pixels = options.quarters, round(options.megapixels * 1e6) or math.inf
        smaller = {f"{k.width}x{k.height}": self._smaller(k) for k in cameras.values() if self._smaller(k) != k}
        for size, k in smaller.items():
            self.notices.append(f"pictures of {size} are made {k.width}x{k.height} (--megapixels)")
        self.info = StreamInfo(
            source=source,
            cameras={name: self._smaller(rotate_intrinsics(k, self._quarters)) for name, k in sorted(cameras.items())},
            label_set=labels,
            frame_hz=hz,
            metadata={SCALE_KEY: scale_from} if scale_from else {},
        )

    def __len__(self) -> int:
        return len(self._pictures)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame. Raises BadFrameError: it cannot be used."""
        picture = self._pictures[number]
        if picture.fault is not None:
            raise picture.fault
        assert not isinstance(picture.pose, BadFrameError)
        pose = picture.pose.copy()
        pose[:3, 3] *= self._factor
        check_frame_pose(pose, picture.file)
        rgb, encoded = self._read_rgb(picture.file)
        size = (rgb.shape[0], rgb.shape[1])
        own = _at_size(picture, size)
        lens = self._rectifier(picture.view or own, picture.file)
        label, label_error = None, None
        if picture.label_file is not None and self._labels is not None:
            try:
                label = self._read_label(picture.label_file, self._labels, size)
            except BadFrameError as error:
                label_error = error
        changed = own.distorted or own != (picture.view or own)
        if picture.view is not None and changed:
            rgb = _in_view(rgb, own, picture.view, cv2.INTER_AREA)
            label = None if label is None else _in_view(label, own, picture.view, cv2.INTER_NEAREST)
        elif changed:
            rgb = lens(np.ascontiguousarray(rgb[..., ::-1]))
        depth = sigma = None
        if picture.depth_file is not None and self._with_depth:
            if self._read_depth is not None:
                depth = self._read_depth(picture, lens)
            elif picture.depth_file.exists():
                depth = self._depth(picture.depth_file, lens, rgb, picture.confidence_file)
        if picture.sigma_file is not None and depth is not None:
            sigma = self._depth(picture.sigma_file, lens, rgb)
        frame = PosedFrame(
            stamp_ns=self._stamps_ns[number],
            seq=number if picture.seq is None else picture.seq,
            camera_id=picture.camera_id,
            rgb=rgb,
            depth_m=depth,
            label=None if label is None else self._new_ids[lens.nearest(label)],
            intrinsics=lens.intrinsics,
            T_world_camera=pose,
            depth_sigma_m=sigma,
            label_is_pseudo=picture.pseudo_label and label is not None,
        )
        was_jpeg = encoded is not None and encoded.encoding == "jpeg"
        if changed or self._quarters % 4:
            encoded = None
        frame = rotate_frame(frame, self._quarters)
        if (smaller := self._smaller(frame.intrinsics)) != frame.intrinsics:
            frame = resize_frame(frame, smaller)
            encoded = EncodedImage("jpeg", encode_rgb(frame.rgb, "jpeg", JPEG_QUALITY)) if was_jpeg else None
        return LoadedFrame(frame, encoded, label_error)

    def _smaller(self, k: CameraIntrinsics) -> CameraIntrinsics:
        """Intrinsics of the picture as the log has it."""
        factor = (self._pixels / (k.width * k.height)) ** 0.5
        return k if factor >= 1 else working_intrinsics(k, round(k.width * factor / 4) * 4)

    def _depth(self, file: Path, lens: Rectifier, rgb: UInt8, confidence: Path | None = None) -> Float32:
        """Depth, or its spread, (H, W) in metres, in the pixels of the rectified picture."""
        depth_m = read_depth(file, self.depth_scale)
        if confidence is not None and confidence.exists():
            depth_m[read_plane(confidence, "uint8", (depth_m.shape[0], depth_m.shape[1]), "confidence") == 0] = 0
        return lens.nearest(depth_of_size(depth_m, (rgb.shape[0], rgb.shape[1]), file))

    def _rectifier(self, intrinsics: CameraIntrinsics, file: Path) -> Rectifier:
        try:
            return self._rectifiers(intrinsics)
        except ConfigError as error:
            raise BadFrameError(file, str(error)) from error


def _at_size(picture: PosedPicture, size: tuple[int, int]) -> CameraIntrinsics:
    """Intrinsics of a picture of a size (height, width)."""
    k, (height, width) = picture.intrinsics, size
    if (k.width, k.height) == (width, height):
        return k
    if not same_view((k.width, k.height), (width, height)):
        raise BadFrameError(
            picture.file,
            f"the image is {width}x{height}, the camera's intrinsics say {k.width}x{k.height}; resize it or fix the "
            "intrinsics",
        )
    return scale_intrinsics(k, width, height)


def depth_of_size(depth_m: Float32, size: tuple[int, int], file: Path) -> Float32:
    """Depth (H, W) of the size (height, width) of its picture, each pixel from the nearest one.

    Raises BadFrameError: it shows another part of the view.
    """
    if depth_m.shape == size:
        return depth_m
    (rows, columns), (height, width) = depth_m.shape, size
    if not same_view((rows, columns), size):
        raise BadFrameError(
            file,
            f"the depth image is {columns}x{rows}, the colour image {width}x{height}, which is another form: register "
            "depth to the colour image, or import without it (--topic depth=none)",
        )
    return np.asarray(cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)


def _in_view(image: UInt8, own: CameraIntrinsics, view: CameraIntrinsics, interpolation: int) -> UInt8:
    """Colour or classes of a camera in the pixels of another one at its place; classes outside are 0, unknown."""
    size, border = (view.width, view.height), cv2.BORDER_CONSTANT
    if interpolation == cv2.INTER_AREA:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        own, interpolation, border = scale_intrinsics(own, *size), cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
    own_of_view = camera_matrix(own) @ np.linalg.inv(camera_matrix(view))  # pixels to pixels
    flags = interpolation | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, own_of_view[:2], size, flags=flags, borderMode=border), np.uint8)


def _once_each(pictures: Sequence[PosedPicture], notices: list[str]) -> list[PosedPicture]:
    """The pictures without those that are there before."""
    first = {picture.file: picture for picture in reversed(pictures)}
    again = [str(picture.file) for picture in pictures if first[picture.file] is not picture]
    notices += left_out_notice("picture", again, "which are there twice: the first pose of each counts")
    return [picture for picture in pictures if first[picture.file] is picture]


def _in_time(pictures: Sequence[PosedPicture], hz: float, notices: list[str]) -> tuple[list[PosedPicture], list[int]]:
    """The pictures in the order of their times and their stamps, which are made up where not each has a time."""
    usable = [picture for picture in pictures if picture.fault is None]
    missing = sum(picture.stamp_ns is None for picture in usable)
    if missing:
        why = "there are no times" if missing == len(usable) else f"{missing} of {len(usable)} pictures have no time"
        notices.append(f"{why}: stamps are made up at {hz:g} frames a second")
        return list(pictures), [round(number * 1e9 / hz) for number in range(len(pictures))]
    times: list[int] = []
    for picture in pictures:  # those that cannot be used stay behind the one before them
        times.append(picture.stamp_ns if isinstance(picture.stamp_ns, int) else (times or [0])[-1])
    order = sorted(range(len(times)), key=times.__getitem__)
    if order != list(range(len(times))):
        notices.append("the times of the pictures go back; pictures are sorted by them")
    last: dict[str, int] = {}
    stamps_ns: list[int] = []
    for number in order:
        camera = pictures[number].camera_id
        stamps_ns.append(max(times[number], last.get(camera, -SHIFT_NS) + SHIFT_NS))
        if pictures[number].fault is None:
            last[camera] = stamps_ns[-1]
    shifted = sum(stamp != times[number] for stamp, number in zip(stamps_ns, order, strict=True))
    if shifted:
        notices.append(f"{counted(shifted, 'picture')} with the time of another one; stamps are put behind it by 1 ms")
    return [pictures[number] for number in order], stamps_ns
