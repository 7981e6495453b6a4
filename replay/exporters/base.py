"""What exporters share: the frame that they get, formats of numbers, the way of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import scipy  # loads `spatial` when it is first used
from numpy.typing import NDArray

from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import encode_rgb
from semantic_mapper.types import Float32, Float64, PosedFrame, UInt8

MAX_PATH = 4096  # positions kept of a camera's path; then every other one goes


@dataclass(frozen=True, slots=True, eq=False)
class ExportFrame:
    """A frame of a log.

    Args:
        frame: Decoded.
        rgb: Its colour image as the log holds it, packed again as PNG where the log holds raw pixels.
        depth_scale: Units a metre of its depth image as the log holds it; 0 where it has none, or float32.
    """

    frame: PosedFrame
    rgb: EncodedImage
    depth_scale: float


class LeftOut(Exception):  # noqa: N818 - the house's errors are for people; this one tells a caller to go on
    """A frame that a format cannot hold, and why."""


class Exporter(Protocol):
    """Writes one format."""

    notices: list[str]  # what the format could not hold of all frames

    def add(self, item: ExportFrame) -> None:
        """Take one frame.

        Raises:
            LeftOut: the format cannot hold it; the others go on.
        """
        ...

    def finish(self) -> None:
        """Write what comes after the last frame."""
        ...


def encoded(rgb: UInt8) -> EncodedImage:
    """A colour image as PNG."""
    return EncodedImage("png", encode_rgb(rgb, "png", 0))


def write_png(file: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """One channel, 8 or 16 bits; level 1, a third of the time for some more bytes.

    Raises:
        OSError: it cannot be written.
    """
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    file.write_bytes(data.tobytes())


def depth_units(depth_m: Float32, scale: float) -> tuple[NDArray[np.uint16], float]:
    """Depth as uint16, and the largest error of that in metres; what is too far away becomes 0."""
    units = np.rint(np.nan_to_num(depth_m, posinf=0.0, neginf=0.0) * np.float32(scale))
    held = np.where((units >= 0) & (units <= 65535), units, 0).astype(np.uint16)
    back = held.astype(np.float32) / np.float32(scale)
    error = np.abs(back - np.nan_to_num(depth_m, posinf=0.0, neginf=0.0))
    return held, float(error.max(initial=0.0))


def quaternion(T_a_b: Float64) -> Float64:
    """Rotation of a pose (4, 4) as (x, y, z, w)."""
    return np.asarray(scipy.spatial.transform.Rotation.from_matrix(T_a_b[:3, :3]).as_quat(), np.float64)


def seconds(stamp_ns: int) -> str:
    """Nanoseconds as seconds with nine places, exactly."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


class CameraPath:
    """A bounded, evenly spread sample of a camera's poses, whatever their number. One thread adds; any may read."""

    def __init__(self) -> None:
        self.poses: list[Float64] = []
        self._seen = -1
        self._stride = 1

    def add(self, T_world_camera: Float64) -> None:
        """The next pose (4, 4)."""
        self._seen += 1
        if self._seen % self._stride == 0:
            self.poses.append(T_world_camera.copy())
        if len(self.poses) > MAX_PATH:
            self.poses = self.poses[::2]
            self._stride *= 2
