"""All pixels of many frames, each with its own camera, as rays with the colour and depth that they should see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from semantic_mapper.errors import FrameError, PoseError
from semantic_mapper.geometry import check_pose
from semantic_mapper.imaging import resize_depth, resize_rgb, working_intrinsics
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import CameraIntrinsics, Float32, Int64, PosedFrame, RayBatch, UInt8

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class FrameRays:
    """Pixels of F frames, P in all, frame by frame and row by row."""

    intrinsics: tuple[CameraIntrinsics, ...]  # of each frame, at working width; sizes may differ
    T_world_camera: Float32  # (F, 4, 4) float32
    first: Int64  # (F + 1,) number of each frame's first pixel
    rgb: UInt8  # (P, 3) uint8
    depth_m: Float32  # (P,) z in metres, 0 = none

    def __len__(self) -> int:
        return int(self.first[-1])

    def frame_of(self, pixels: Int64) -> Int64:
        """Number of the frame (R,) of each pixel."""
        return np.searchsorted(self.first, pixels, side="right") - 1

    def rays(self, pixels: Int64, near_m: float) -> RayBatch:
        """Rays of the world through pixels (R,), without bound behind."""
        frame = self.frame_of(pixels)
        camera = np.array([(k.fx, k.fy, k.cx, k.cy, k.width) for k in self.intrinsics])[frame]
        v, u = np.divmod(pixels - self.first[frame], camera[:, 4].astype(np.int64))
        towards = np.stack(
            ((u - camera[:, 2]) / camera[:, 0], (v - camera[:, 3]) / camera[:, 1], np.ones(len(u))), axis=1
        )
        direction = np.einsum("rij,rj->ri", self.T_world_camera[frame, :3, :3], towards.astype(np.float32))
        near, far, none = (torch.full((len(u),), x) for x in (near_m, np.inf, 0.0))
        origin = np.ascontiguousarray(self.T_world_camera[frame, :3, 3])
        return RayBatch(torch.from_numpy(origin), torch.from_numpy(direction), near, far, none)

    def colours(self, pixels: Int64) -> torch.Tensor:
        """Colours (R, 3) in [0, 1] of pixels (R,)."""
        return torch.from_numpy(self.rgb[pixels] / np.float32(255))

    def pixels_of(self, frame: int) -> Int64:
        """Numbers of all pixels of a frame, row by row."""
        return np.arange(self.first[frame], self.first[frame + 1])

    def image_size(self, frame: int) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.intrinsics[frame].height, self.intrinsics[frame].width


def frame_rays(frames: Sequence[PosedFrame], width: int) -> FrameRays:
    """The pixels of frames at a working width. Raises FrameError: no frames."""
    if not frames:
        raise FrameError("there are no frames to take rays from")
    intrinsics = tuple(working_intrinsics(f.intrinsics, width) for f in frames)
    return FrameRays(
        intrinsics,
        np.stack([f.T_world_camera for f in frames]).astype(np.float32),
        np.concatenate(([0], np.cumsum([k.width * k.height for k in intrinsics]))).astype(np.int64),
        np.concatenate([resize_rgb(f, k).reshape(-1, 3) for f, k in zip(frames, intrinsics, strict=True)]),
        np.concatenate([resize_depth(f, k).reshape(-1) for f, k in zip(frames, intrinsics, strict=True)]),
    )


def usable_frames(frames: Sequence[PosedFrame]) -> list[PosedFrame]:
    """The frames whose poses are rigid; others are left out, with a warning that counts them."""
    good: list[PosedFrame] = []
    reasons: list[str] = []
    for frame in frames:
        try:
            check_pose(frame.T_world_camera, f"frame seq={frame.seq}")
            good.append(frame)
        except PoseError as error:
            reasons.append(str(error))
    if reasons:
        _log.warning("frames_left_out", count=len(reasons), reason=reasons[0])
    return good
