"""What exporters share: the frame that they get, formats of numbers, the way of a camera."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import scipy  # loads `spatial` when it is first used

from semantic_mapper.config import nearest
from semantic_mapper.errors import ConfigError
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import encode_rgb
from semantic_mapper.types import Float64, PosedFrame, UInt8

Name = TypeVar("Name", bound=str)
MAX_PATH = 4096  # positions kept of a camera's path; then every other one goes


@dataclass(frozen=True, slots=True, eq=False)
class ExportFrame:
    """A frame of a log."""

    frame: PosedFrame
    rgb: EncodedImage  # its colour image as the log holds it, packed again as PNG where the log holds raw pixels
    depth_scale: float  # units a metre of its depth image as the log holds it; 0 where it has none, or float32


class LeftOut(Exception):  # noqa: N818 - the house's errors are for people; this one tells a caller to go on
    """A frame that a format cannot hold, and why."""


class Exporter(Protocol):
    """Writes one format."""

    notices: list[str]  # what the format could not hold of all frames

    def add(self, item: ExportFrame) -> None:
        """Take one frame; raises ``LeftOut`` where the format cannot hold it."""
        ...

    def finish(self) -> None:
        """Write what comes after the last frame."""
        ...


def choose_format(path: Path, given: str | None, suffixes: dict[str, Name], formats: tuple[Name, ...]) -> Name:
    """The one of ``formats`` in which to write a file or folder: as ``given``, else what its suffix tells.

    Raises ConfigError: neither is one.
    """
    wanted = given or suffixes.get(path.suffix.lower())
    for name in formats:
        if name == wanted:
            return name
    hint = nearest(path.suffix.lower(), [suffix for suffix in suffixes if suffix])
    raise ConfigError(f"{path}: its ending names no format of --format {'|'.join(formats)}{hint}")


def encoded(rgb: UInt8) -> EncodedImage:
    """A colour image as PNG."""
    return EncodedImage("png", encode_rgb(rgb, "png", 0))


def quaternion(T_a_b: Float64) -> Float64:
    """Rotation of a pose (4, 4) as (x, y, z, w)."""
    return np.asarray(scipy.spatial.transform.Rotation.from_matrix(T_a_b[:3, :3]).as_quat(), np.float64)


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
