"""Images, depth images and camera calibrations as ROS messages hold them.

Depth follows REP 118: 16UC1 is millimetres with 0 for no measurement, 32FC1 is metres with NaN. ``compressedDepth`` is
12 bytes and a PNG; of 32FC1 it holds the inverse depth, quantised.
"""

from __future__ import annotations

import re
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import CodecError, ConfigError, FrameError, ImportSourceError
from semantic_mapper.replay.importers.base import metres
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import decode_image_file, depth_from_uint16
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

UNITS_PER_M = 1000.0  # of 16-bit depth
# Encoding -> bytes a pixel, and what makes RGB of it; None = it is RGB.
COLOR_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
}
GREY_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
DEPTH_ENCODINGS = {"16UC1": np.dtype("<u2"), "mono16": np.dtype("<u2"), "32FC1": np.dtype("<f4")}
_MAX_SIDE = 1 << 14  # pixels
_COMPRESSED_DEPTH_HEAD = struct.Struct("<iff")  # format, and A and B of the quantised inverse depth


def is_depth(topic: str, encoding: str) -> bool:
    """Whether images of this topic are depth.

    Args:
        topic: Its name, which decides where the encoding leaves it open.
        encoding: Of an image, or the format of a compressed one.
    """
    pixels = re.split("[; ]", encoding.strip())[0]
    named = "depth" in topic.lower()
    return "compressedDepth" in encoding or pixels in ("16UC1", "32FC1") or (pixels == "mono16" and named)


def is_grey(encoding: str) -> bool:
    """Whether images of this encoding, or compressed format, have no colour."""
    return re.split("[; ]", encoding.strip())[0] in GREY_ENCODINGS


def color_image(message: Any) -> UInt8:
    """RGB (H, W, 3) of a ``sensor_msgs/Image``.

    Raises:
        CodecError: another encoding, or fewer bytes than its size needs.
    """
    known = COLOR_ENCODINGS | GREY_ENCODINGS
    if message.encoding not in known:
        raise CodecError(f"images of encoding '{message.encoding}' are not read, only {', '.join(known)}")
    bytes_a_pixel, code = known[message.encoding]
    rows = _rows(message, bytes_a_pixel)
    pixels = rows.reshape(message.height, message.width, bytes_a_pixel)
    if code is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, code), np.uint8)
    except cv2.error as error:
        raise CodecError(
            f"{message.encoding} of {message.width}x{message.height} is no image: {error.err or error}"
        ) from error


def compressed_color_image(message: Any) -> tuple[UInt8, EncodedImage]:
    """RGB (H, W, 3) of a ``sensor_msgs/CompressedImage``, and its file as it is.

    Raises:
        CodecError: neither JPEG nor PNG, or damaged.
    """
    data = message.data.tobytes()
    rgb, encoding = decode_image_file(data)
    return rgb, EncodedImage(encoding, data)


def depth_image(message: Any, units_per_m: float = UNITS_PER_M) -> Float32:
    """Depth (H, W) in metres of a ``sensor_msgs/Image``, 0 where nothing was measured.

    Raises:
        CodecError: another encoding, or fewer bytes than its size needs.
    """
    if message.encoding not in DEPTH_ENCODINGS:
        known = ", ".join(DEPTH_ENCODINGS)
        raise CodecError(f"depth images of encoding '{message.encoding}' are not read, only {known}")
    kind = DEPTH_ENCODINGS[message.encoding]
    values = _rows(message, kind.itemsize).view(kind.newbyteorder(">") if message.is_bigendian else kind)
    return _metres(values, units_per_m)


def compressed_depth_image(message: Any, units_per_m: float = UNITS_PER_M) -> Float32:
    """Depth (H, W) in metres of a ``sensor_msgs/CompressedImage`` of transport compressedDepth, or a 16-bit PNG.

    Raises:
        CodecError: another compression than PNG, or damaged.
    """
    data = message.data.tobytes()
    quantised = None
    if "compressedDepth" in message.format:
        if len(data) <= _COMPRESSED_DEPTH_HEAD.size:
            raise CodecError(f"compressed depth of {len(data)} bytes holds no image")
        if "rvl" in message.format.lower():
            raise CodecError("depth compressed by RVL is not read: record it as PNG, or republish it raw")
        _, a, b = _COMPRESSED_DEPTH_HEAD.unpack_from(data)
        quantised = (a, b) if message.format.strip().startswith("32FC1") else None
        data = data[_COMPRESSED_DEPTH_HEAD.size :]
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise CodecError(f"the depth image is damaged: {error}") from error
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise CodecError(f"the depth image of format '{message.format}' is damaged, or no PNG of 16 bits")
    values = np.asarray(image, np.uint16)
    if quantised is None:
        return _metres(values, units_per_m)
    a, b = quantised
    with np.errstate(divide="ignore", invalid="ignore"):
        return _metres(np.where(values > 0, a / (values.astype(np.float32) - b), 0).astype(np.float32))


def intrinsics(
    info: Any, K: NDArray[np.float64], D: NDArray[np.float64], size: tuple[int, int], *, rectified: bool
) -> CameraIntrinsics:
    """Intrinsics of a ``sensor_msgs/CameraInfo``.

    Args:
        info: The message; its matrices are called differently in ROS 1 and 2, so the caller hands them in.
        K: (9,) of the raw image, or (12,) of the rectified one (P).
        D: Coefficients of the lens.
        size: (width, height) of the images.
        rectified: The image is: its lens distortion has been removed already.

    Raises:
        ImportSourceError: not calibrated, a lens model that is not OpenCV's, skew, binning or a region of interest.
    """
    where = "its camera_info"
    roi = info.roi
    cut = 0 < roi.width < info.width or 0 < roi.height < info.height
    if info.binning_x > 1 or info.binning_y > 1 or roi.x_offset or roi.y_offset or cut:
        raise ImportSourceError(f"{where} tells of binning or a region of interest, which is not read: record it whole")
    fx, cx, fy, cy = (float(K[i]) for i in ((0, 2, 5, 6) if rectified else (0, 2, 4, 5)))
    if K[1] or (not rectified and K[3]):
        raise ImportSourceError(f"{where} has skew, which is not undone: calibrate without it, and record again")
    if not fx or not fy:
        matrix = "P" if rectified else "K"
        raise ImportSourceError(f"{where} is not calibrated ({matrix} is zero): calibrate the camera, and record again")
    try:
        if rectified:
            return CameraIntrinsics(fx, fy, cx, cy, *size)
        return lens_intrinsics(info.distortion_model, D.tolist(), (fx, fy, cx, cy), size)
    except ConfigError as error:
        raise ImportSourceError(
            f"{where} cannot be used: {error}; or rectify the images (image_proc), and name that topic"
        ) from error
    except FrameError as error:
        raise ImportSourceError(f"{where} cannot be used: {error}") from error


def _rows(message: Any, bytes_a_pixel: int) -> UInt8:
    """The bytes of an image without padding, (H, W * bytes_a_pixel); raises CodecError."""
    height, width, step = message.height, message.width, message.step
    used = width * bytes_a_pixel
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE) or step < used or len(message.data) < height * step:
        raise CodecError(
            f"an image of {width}x{height} with {step} bytes a row does not fit into its {len(message.data)} bytes"
        )
    return np.ascontiguousarray(message.data[: height * step].reshape(height, step)[:, :used])


def _metres(values: NDArray[np.generic], units_per_m: float = UNITS_PER_M) -> Float32:
    if values.dtype.kind == "u":
        return depth_from_uint16(values.astype(np.uint16), units_per_m)
    return metres(values)
