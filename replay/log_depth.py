"""Depth of the frames of a log that has no depth sensor, computed from its pictures as ``replay`` computes it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semantic_mapper.config import DepthConfig
from semantic_mapper.errors import FrameError
from semantic_mapper.imaging import resize_depth, resize_spread, working_intrinsics
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.frame_depth import FrameDepth
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class ComputedFrame:
    """What was computed of a frame, at the size that depth is computed at.

    Args:
        depth_m: (h, w) float32, 0 = none.
        depth_sigma_m: (h, w) float32 its one-sigma spread.
        T_world_camera: (4, 4) pose that goes with it.
    """

    depth_m: Float32
    depth_sigma_m: Float32
    T_world_camera: Float64

    def on(self, frame: PosedFrame) -> PosedFrame:
        """The frame with this depth, enlarged to its size, at this pose."""
        size = frame.intrinsics.width, frame.intrinsics.height
        depth, sigma = (
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
            for image in (self.depth_m, self.depth_sigma_m)
        )
        return replace(frame, depth_m=depth, depth_sigma_m=sigma, T_world_camera=self.T_world_camera)


def compute_depths(
    frames: Iterable[PosedFrame], config: DepthConfig, on_frame: Callable[[int], None] = lambda done: None
) -> dict[tuple[str, int], ComputedFrame]:
    """What was computed of each frame without a sensor's depth, by its camera and stamp.

    Frames whose pictures nothing can be computed from (dark, blurred, standing still) are left out, with a line in the
    log. No map gives hints, so depth is a little less exact than in ``replay``.

    Args:
        frames: In order.
        config: ``source`` "auto" or "computed", or nothing is computed.
        on_frame: Called with the number of frames that are read.
    """
    computer, found = FrameDepth(config, _no_hint), dict[tuple[str, int], ComputedFrame]()
    for frame in _through(computer, frames, on_frame):
        if frame.depth_m is None or frame.depth_sigma_m is None:
            continue
        small = working_intrinsics(frame.intrinsics, config.from_motion.width)
        sigma_m = resize_spread(frame, small)
        assert sigma_m is not None
        found[frame.camera_id, frame.stamp_ns] = ComputedFrame(
            resize_depth(frame, small), sigma_m, frame.T_world_camera
        )
    return found


def _through(
    computer: FrameDepth, frames: Iterable[PosedFrame], on_frame: Callable[[int], None]
) -> Iterator[PosedFrame]:
    for number, frame in enumerate(frames):
        try:
            yield from computer.push(frame)
        except FrameError as error:
            _log.warning("no_depth_computed", seq=frame.seq, reason=str(error))
        on_frame(number + 1)
    yield from computer.finish()


def _no_hint(frame: PosedFrame, intrinsics: CameraIntrinsics) -> tuple[Float32, np.ndarray]:
    empty = np.zeros((intrinsics.height, intrinsics.width), np.float32)
    return empty, empty > 0
