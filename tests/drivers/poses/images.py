"""Images and cameras for tests of poses."""

from collections.abc import Iterable, Iterator
from typing import Self

import cv2
import numpy as np

from semantic_mapper.drivers.base import Camera, CameraImage, PoseEstimate
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

INTRINSICS = CameraIntrinsics(20.0, 20.0, 7.5, 5.5, 16, 12)
MS = 1_000_000


def rigid(turn: Iterable[float] = (0, 0, 0), shift: Iterable[float] = (0, 0, 0)) -> Float64:
    """(4, 4) of a rotation vector and a position."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array(list(turn), np.float64))[0]
    T[:3, 3] = list(shift)
    return T


def image(
    stamp_ns: int, seq: int = 0, camera_id: str = "cam", depth: bool = True, own: Float64 | None = None
) -> CameraImage:
    """A grey one."""
    depth_m: Float32 | None = np.ones((12, 16), np.float32) if depth else None
    pose = None if own is None else PoseEstimate(own, "vio", 0.01)
    return CameraImage(stamp_ns, seq, camera_id, np.full((12, 16, 3), 90, np.uint8), depth_m, INTRINSICS, pose)


def as_image(frame: PosedFrame) -> CameraImage:
    """A frame without what it knows of its pose."""
    return CameraImage(frame.stamp_ns, frame.seq, frame.camera_id, frame.rgb, frame.depth_m, frame.intrinsics)


class ListCamera(Camera):
    """Gives the images of a list."""

    def __init__(self, images: Iterable[CameraImage]) -> None:
        super().__init__("cam")
        self.images = list(images)
        self.is_open = False
        self.stopped = False
        self._info = StreamInfo("list", {"cam": INTRINSICS})

    @property
    def warnings(self) -> tuple[str, ...]:
        return ("the lens cap is on",)

    def __enter__(self) -> Self:
        self.is_open = True
        return self

    def __exit__(self, *error: object) -> None:
        self.is_open = False

    def __iter__(self) -> Iterator[CameraImage]:
        return iter(self.images)

    def stop(self) -> None:
        self.stopped = True
