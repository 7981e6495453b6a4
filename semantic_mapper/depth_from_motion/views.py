"""A frame prepared for matching: small images, their census, and the depth that was found for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import working_intrinsics
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int32, PosedFrame, UInt8


class DepthEstimate(NamedTuple):
    """Depth of a view.

    Args:
        depth_m: (h, w) float32 z in metres, 0 = none.
        sigma_m: (h, w) float32 one-sigma spread in metres, 0 where there is no depth.
    """

    depth_m: Float32
    sigma_m: Float32


@dataclass(frozen=True, slots=True, eq=False)
class PreparedView:
    """A frame at the working size, with what matching looks up.

    Args:
        stamp_ns: Of the frame.
        intrinsics: At the working size (h, w).
        intrinsics_double: Of the image at twice the size. Pixel k of ``census`` covers coordinates k to k + 1 of it.
        T_world_camera: (4, 4) float64.
        rgb, gray: (h, w, 3), (h, w) uint8.
        census: (2h, 2w) int32; pixel (2y, 2x) belongs to pixel (y, x) of the working size.
        estimate: Depth that was found for the view earlier; None where there was none.
    """

    stamp_ns: int
    intrinsics: CameraIntrinsics
    intrinsics_double: CameraIntrinsics
    T_world_camera: Float64
    rgb: UInt8
    gray: UInt8
    census: Int32
    estimate: DepthEstimate | None = None


def prepare_view(frame: PosedFrame, width: int) -> PreparedView:
    """Prepare a frame at a working width (never larger than the image); its pose is the frame's.

    The census is that of the image at twice the size, smoothed over 2x2 pixels: every second one is then a pixel of the
    working size, and sources are looked up at half pixels.
    """
    intrinsics = working_intrinsics(frame.intrinsics, width)
    double = scale_intrinsics(frame.intrinsics, 2 * intrinsics.width, 2 * intrinsics.height)
    size = (double.width, double.height)
    gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    if size != (frame.intrinsics.width, frame.intrinsics.height):
        larger = double.width > frame.intrinsics.width
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA)
    smooth = np.asarray(cv2.blur(gray, (2, 2), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE), np.uint8)
    small = (intrinsics.width, intrinsics.height)
    shrinks = intrinsics.width < frame.intrinsics.width
    return PreparedView(
        stamp_ns=frame.stamp_ns,
        intrinsics=intrinsics,
        intrinsics_double=double,
        T_world_camera=frame.T_world_camera,
        rgb=np.asarray(cv2.resize(frame.rgb, small, interpolation=cv2.INTER_AREA), np.uint8)
        if shrinks
        else np.ascontiguousarray(frame.rgb),
        gray=np.ascontiguousarray(smooth[::2, ::2]),
        census=census_transform(smooth, 2),
    )


def census_transform(gray: UInt8, spacing: int) -> Int32:
    """Census transform (H, W) int32: 24 bits, whether each of the 5x5 pixels ``spacing`` apart is darker."""
    padded = np.pad(gray, 2 * spacing, mode="edge")
    out = np.empty(gray.shape, np.int32)
    compare_with_middle(len(gray), padded, out, spacing)
    return out


@parallel_kernel()
def compare_with_middle(count: int, padded: UInt8, census: Int32, spacing: int) -> None:
    """The transform of `census_transform`.

    Args:
        count: H, rows.
        padded: (H + 4 * spacing, W + 4 * spacing) image with a margin of 2 * spacing on each side.
        census: (H, W) int32, written.
    """
    ...
