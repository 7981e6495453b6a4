"""A stereo pair as a ``Camera``: the device's images cut in halves, rectified, and matched."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Self

import msgspec

from semantic_mapper.drivers import registry
from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.calibration import load_stereo
from semantic_mapper.drivers.live import NOT_CALIBRATED
from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.drivers.stereo.config import Config
from semantic_mapper.drivers.stereo.depth import StereoDepth
from semantic_mapper.drivers.v4l2 import devices
from semantic_mapper.errors import CameraError
from semantic_mapper.types import UInt8

_OURS = ("device", "calibration", "uncalibrated", "width", "height")  # of the device's driver, set here


def list_devices() -> list[FoundCamera]:
    """None: a pair is listed as the device of kind v4l2 that it is."""
    return []


class StereoCamera(Camera):
    """The left camera of a pair, with depth; opened when it is entered."""

    def __init__(self, config: Config, camera_id: str) -> None:
        where = f"stereo pair at {config.device}"
        if not config.device:
            raise CameraError(
                f"camera '{camera_id}': no device is named; `doctor --cameras` lists what is connected; give its "
                'address as device = "/dev/v4l/by-id/..."'
            )
        if not config.calibration:
            raise CameraError(
                f"{where}: has no calibration; make one with `semantic-mapper calibrate --stereo`, and name it with "
                'calibration = "FOLDER"'
            )
        taken = sorted(set(config.source) & set(_OURS))
        if taken:
            raise CameraError(f"{where}: `{taken[0]}` cannot be a key of `source`: it is set here")
        pair = load_stereo(Path(config.calibration))
        self._depth = StereoDepth(pair, config.width, config.min_depth_m, config.max_depth_m)
        self._size = (2 * pair.left.width, pair.left.height)
        self._swapped = pair.swapped
        super().__init__(camera_id)
        kind, settings = "opencv", {"source": config.device}
        if Path(config.device).is_relative_to(devices.DEVICES):
            kind, settings = "v4l2", {"device": config.device, "width": self._size[0], "height": self._size[1]}
        # Its own rectification is off: that of one lens would be wrong for both.
        settings |= {**config.source, "uncalibrated": True}
        self._source = registry.open_camera(kind, settings, camera_id, where)
        self.can_wait = self._source.can_wait

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        return tuple(text for text in self._source.warnings if text != NOT_CALIBRATED)

    @property
    def last_poll_time(self) -> float:
        """As of ``Camera``."""
        return self._source.last_poll_time

    def __enter__(self) -> Self:
        """As of ``Camera``; images of another size than both of the calibration side by side are refused."""
        self._source.__enter__()
        source = self._source.info
        (given,) = source.cameras.values()
        if (given.width, given.height) != self._size:
            self._source.__exit__(None, None, None)
            raise CameraError(
                f"{source.source}: gives images of {given.width}x{given.height}, and the pair was calibrated at "
                f"{self._size[0]}x{self._size[1]} side by side; calibrate for a size that it offers"
            )
        self._info = msgspec.structs.replace(
            source,
            source=f"stereo {source.source}",
            cameras={self._camera_id: self._depth.intrinsics},
            metadata={
                **source.metadata,
                "driver": "stereo",
                "baseline_m": f"{self._depth.baseline_m:.4f}",
                "disparities": str(self._depth.disparities),
            },
        )
        return self

    def __exit__(self, *error: object) -> None:
        self._source.__exit__(*error)

    def __iter__(self) -> Iterator[CameraImage]:
        """Left images with their depth; otherwise as the device's driver gives them."""
        for image in self._source:
            left, right = self._depth.rectify(*halves(image.rgb, swapped=self._swapped))
            depth_m = self._depth.depth(left, right)
            yield replace(image, rgb=left, depth_m=depth_m, intrinsics=self._depth.intrinsics)

    def stop(self) -> None:
        """As of ``Camera``."""
        self._source.stop()


def halves(rgb: UInt8, *, swapped: bool = False) -> tuple[UInt8, UInt8]:
    """(H, 2 W, 3) -> the left and the right camera's images, (H, W, 3) each."""
    middle = rgb.shape[1] // 2
    first, second = rgb[:, :middle], rgb[:, middle : 2 * middle]
    return (second, first) if swapped else (first, second)


open_camera = StereoCamera
