"""Frames at a working size (colours by area, depth by nearest pixel, holes filled on request), and turned upright."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import expect_shape, scale_intrinsics
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import MAX_DEPTH_M, MIN_DEPTH_M, CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

REACH = 1 / 32  # of the image's width is looked at to either side: sensors err by their own pixels, not by ours


def working_intrinsics(intrinsics: CameraIntrinsics, width: int) -> CameraIntrinsics:
    """Intrinsics at a working width (never larger than the image), height in proportion, a multiple of 4."""
    width = min(width, intrinsics.width)
    height = max(4, round(intrinsics.height * width / intrinsics.width / 4) * 4)
    return scale_intrinsics(intrinsics, width, height)


def resize_rgb(frame: PosedFrame, intrinsics: CameraIntrinsics) -> UInt8:
    """Colour image (H, W, 3) of a frame at the size of ``intrinsics``."""
    size = (intrinsics.width, intrinsics.height)
    if size == (frame.intrinsics.width, frame.intrinsics.height):
        return np.ascontiguousarray(frame.rgb)
    return np.asarray(cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def resize_depth(frame: PosedFrame, intrinsics: CameraIntrinsics) -> Float32:
    """Depth (H, W) of a frame at the size of ``intrinsics``, 0 where it is not from ``MIN_DEPTH_M`` to ``MAX_DEPTH_M``.

    Nearest pixel, not averaged: a mean of two depths across an edge lies on no surface.
    """
    if frame.depth_m is None:
        return np.zeros((intrinsics.height, intrinsics.width), np.float32)
    depth = frame.depth_m
    if depth.shape != (intrinsics.height, intrinsics.width):
        depth = cv2.resize(depth, (intrinsics.width, intrinsics.height), interpolation=cv2.INTER_NEAREST_EXACT)
    measured = (depth >= MIN_DEPTH_M) & (depth <= MAX_DEPTH_M)  # False for NaN, too
    return np.where(measured, depth, 0).astype(np.float32)


def resize_spread(frame: PosedFrame, intrinsics: CameraIntrinsics) -> Float32 | None:
    """One-sigma spread (H, W) of ``resize_depth`` in metres; None where no depth was computed from pictures."""
    if frame.depth_sigma_m is None:
        return None
    sigma = frame.depth_sigma_m
    if sigma.shape != (intrinsics.height, intrinsics.width):
        sigma = cv2.resize(sigma, (intrinsics.width, intrinsics.height), interpolation=cv2.INTER_NEAREST_EXACT)
    return np.asarray(sigma, np.float32)


class FrameViews:
    """A frame with its colour and depth at the sizes that a step needs, each resized once. Do not write to them."""

    def __init__(self, frame: PosedFrame, rgb: dict[tuple[int, int], UInt8] | None = None) -> None:
        self.frame = frame
        self._rgb: dict[tuple[int, int], UInt8] = {} if rgb is None else rgb
        self._depth: dict[tuple[int, int], Float32] = {}

    def with_depth(self, depth_m: Float32) -> "FrameViews":
        """The same frame with other depth (H, W); its colours are not resized again."""
        return FrameViews(replace(self.frame, depth_m=depth_m), self._rgb)

    def rgb(self, intrinsics: CameraIntrinsics) -> UInt8:
        """See ``resize_rgb``."""
        size = (intrinsics.width, intrinsics.height)
        if size not in self._rgb:
            self._rgb[size] = resize_rgb(self.frame, intrinsics)
        return self._rgb[size]

    def depth(self, intrinsics: CameraIntrinsics) -> Float32:
        """See ``resize_depth``."""
        size = (intrinsics.width, intrinsics.height)
        if size not in self._depth:
            self._depth[size] = resize_depth(self.frame, intrinsics)
        return self._depth[size]


def is_measured(frame: PosedFrame) -> bool:
    """Whether a sensor measured the depth of a frame."""
    return frame.depth_m is not None and frame.depth_sigma_m is None


def resize_label(label: UInt8, intrinsics: CameraIntrinsics) -> UInt8:
    """Label image at the size of ``intrinsics`` by nearest pixel."""
    size = (intrinsics.width, intrinsics.height)
    return np.asarray(cv2.resize(label, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint8)


def resize_frame(frame: PosedFrame, intrinsics: CameraIntrinsics) -> PosedFrame:
    """The frame with all its images at the size of ``intrinsics``; itself where it has that."""
    if intrinsics == frame.intrinsics:
        return frame
    return replace(
        frame,
        rgb=resize_rgb(frame, intrinsics),
        depth_m=None if frame.depth_m is None else resize_depth(frame, intrinsics),
        depth_sigma_m=resize_spread(frame, intrinsics),
        label=None if frame.label is None else resize_label(frame.label, intrinsics),
        intrinsics=intrinsics,
    )


def fill_holes(depth_m: Float32) -> Float32:
    """Give pixels without depth that of the nearest pixel with one; all 0 stays all 0."""
    holes = (depth_m <= 0).astype(np.uint8)
    if not holes.any() or holes.all():
        return depth_m
    _, nearest = cv2.distanceTransformWithLabels(holes, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.asarray(nearest, np.int32)
    values = np.zeros(int(nearest.max()) + 1, np.float32)
    values[nearest[holes == 0]] = depth_m[holes == 0]
    return values[nearest]


def depth_prior(depth_m: Float32, rgb: UInt8) -> Float32:
    """Depth (H, W) at which the surface of each pixel is expected: without holes, its borders on the image's edges.

    A depth sensor errs at borders: stereo widens what is near and leaves holes next to it, and the nearest measured
    pixel of a hole is often on the wrong surface. Where the neighbourhood of a pixel holds two surfaces, the pixel
    belongs to the one whose pixels look more like it: a joint bilateral filter that chooses between both, so that no
    depth lies between. Raises ShapeError: images of different sizes.

    Args:
        depth_m: (H, W) float32, 0 = not measured; all 0 gives all 0.
        rgb: (H, W, 3) uint8, the view's image.
    """
    sizes = expect_shape(depth_m, "H W", "depth")
    expect_shape(rgb, f"{sizes['H']} {sizes['W']} 3", "rgb")
    filled = np.ascontiguousarray(fill_holes(depth_m), np.float32)
    out = np.empty_like(filled)
    images = filled, np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(rgb)
    draw_borders_to_edges(len(filled), *images, out, max(round(REACH * sizes["W"]), 1))
    return out


@parallel_kernel()
def draw_borders_to_edges(count: int, filled: Float32, measured: Float32, rgb: UInt8, out: Float32, reach: int) -> None:
    """The filter of ``depth_prior``: ``count`` rows, from depth without holes and with, (H, W) each, into ``out``."""


def rotate_intrinsics(intrinsics: CameraIntrinsics, quarters: int) -> CameraIntrinsics:
    """Intrinsics of a rectified image (else FrameError) that was turned clockwise by quarters of a full turn."""
    if intrinsics.distorted:
        raise FrameError("an image with lens distortion cannot be turned by itself; rectify it first")
    k = intrinsics
    for _ in range(quarters % 4):
        k = CameraIntrinsics(k.fy, k.fx, k.height - 1 - k.cy, k.cx, k.height, k.width)
    return k


def rotate_frame(frame: PosedFrame, quarters: int) -> PosedFrame:
    """The frame with its images turned clockwise by this many quarters of a full turn, and its pose and intrinsics with
    them: every pixel keeps its ray in the world.

    Raises FrameError: an image that is not rectified.
    """
    quarters %= 4
    if quarters == 0:
        return frame
    images = {"depth_m": frame.depth_m, "label": frame.label, "depth_sigma_m": frame.depth_sigma_m}
    return replace(
        frame,
        rgb=_rotated(frame.rgb, quarters),
        **{name: None if image is None else _rotated(image, quarters) for name, image in images.items()},
        intrinsics=rotate_intrinsics(frame.intrinsics, quarters),
        T_world_camera=frame.T_world_camera @ _turn(quarters),
    )


def _rotated(image: NDArray[Any], quarters: int) -> NDArray[Any]:
    return np.ascontiguousarray(np.rot90(image, -quarters))


def _turn(quarters: int) -> Float64:
    """(4, 4): turning the image clockwise turns the camera's axes the other way about its optical axis."""
    T = np.eye(4)
    T[:2, :2] = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarters)
    return T
