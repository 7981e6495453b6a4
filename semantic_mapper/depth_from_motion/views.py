"""From a frame to what is matched, small images and their census; and from the depth of these to that of the frame."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import working_intrinsics
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int32, PosedFrame, UInt8


class DepthEstimate(NamedTuple):
    """Depth of a view."""

    depth_m: Float32  # (h, w) float32 z in metres, 0 = none
    sigma_m: Float32  # (h, w) float32 one-sigma spread in metres, 0 where there is no depth


@dataclass(frozen=True, slots=True, eq=False)
class PreparedView:
    """A frame at the working size, with what matching looks up."""

    stamp_ns: int  # of the frame
    intrinsics: CameraIntrinsics  # at the working size (h, w)
    intrinsics_double: CameraIntrinsics  # at twice the size. Pixel k of ``census`` covers coordinates k to k + 1 of it.
    T_world_camera: Float64  # (4, 4) float64
    rgb: UInt8  # (h, w, 3) uint8
    gray: UInt8  # (h, w) uint8
    census: Int32  # (2h, 2w) int32; pixel (2y, 2x) belongs to pixel (y, x) of the working size
    estimate: DepthEstimate | None = None  # depth that was found for the view earlier; None where there was none


def prepare_view(frame: PosedFrame, width: int) -> PreparedView:
    """Prepare a frame at a working width (never larger than the image); its pose is the frame's.

    The census is that of the image at twice the size, smoothed over 2x2 pixels: every second one is then a pixel of the
    working size, and sources are looked up at half pixels.
    """
    k = working_intrinsics(frame.intrinsics, width)
    double = scale_intrinsics(frame.intrinsics, 2 * k.width, 2 * k.height)
    gray = np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    if (double.width, double.height) != (frame.intrinsics.width, frame.intrinsics.height):
        way = cv2.INTER_LINEAR if double.width > frame.intrinsics.width else cv2.INTER_AREA
        gray = cv2.resize(gray, (double.width, double.height), interpolation=way)
    smooth = np.asarray(cv2.blur(gray, (2, 2), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE), np.uint8)
    rgb = cv2.resize(frame.rgb, (k.width, k.height), interpolation=cv2.INTER_AREA)
    return PreparedView(
        stamp_ns=frame.stamp_ns,
        intrinsics=k,
        intrinsics_double=double,
        T_world_camera=frame.T_world_camera,
        rgb=np.asarray(rgb, np.uint8),
        gray=np.ascontiguousarray(smooth[::2, ::2]),
        census=census_transform(smooth, 2),
    )


def census_transform(gray: UInt8, spacing: int) -> Int32:
    """Census transform (H, W) int32: 24 bits, whether each of the 5x5 pixels ``spacing`` apart is darker."""
    padded = np.pad(gray, 2 * spacing, mode="edge")
    out = np.empty(gray.shape, np.int32)
    compare_with_middle(len(gray), padded, out, spacing)
    return out


def enlarge_estimate(estimate: DepthEstimate, coarse_rgb: UInt8, rgb: UInt8) -> DepthEstimate:
    """Bring an estimate (h, w) to the size of ``rgb``, its borders to the image's edges; no depth lies between two
    surfaces.

    Within a surface inverse depth is interpolated, which keeps planes plane. Where the coarse pixels round a pixel
    belong to several surfaces, it takes the one that looks most like it.
    """
    full = DepthEstimate(np.zeros(rgb.shape[:2], np.float32), np.zeros(rgb.shape[:2], np.float32))
    depth_m, sigma_m = np.ascontiguousarray(estimate.depth_m), np.ascontiguousarray(estimate.sigma_m)
    images = np.ascontiguousarray(coarse_rgb), np.ascontiguousarray(rgb)
    enlarge_depth(len(rgb), depth_m, sigma_m, *images, *full)
    return full


@parallel_kernel()
def compare_with_middle(count: int, padded: UInt8, census: Int32, spacing: int) -> None:
    """`census_transform` of an image that has a margin of 2 * spacing on each side; writes ``census`` (H, W)."""


@parallel_kernel()
def enlarge_depth(
    count: int, depth: Float32, sigma: Float32, coarse_rgb: UInt8, rgb: UInt8, out_depth: Float32, out_sigma: Float32
) -> None:
    """The upsampling of `enlarge_estimate`: writes ``out_depth`` and ``out_sigma`` (H, W), zeros before."""
