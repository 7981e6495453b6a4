"""Frames, maps and graphs in plain forms that other tools read."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from semantic_mapper.errors import FrameError
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float64, MapUpdate, PosedFrame, UInt8

MAX_POINTS = 400_000  # of a map that is shown again and again: of a larger one every second point, or third, ...
JPEG_QUALITY = 80
# One point: world metres, colour, class id, confidence in 255ths, 1 where a sensor measured it, else 0, one spare.
POINT = np.dtype(
    [(axis, "<f4") for axis in ("x", "y", "z")]
    + [(name, "u1") for name in ("red", "green", "blue", "alpha", "label", "confidence", "measured", "spare")]
)


def thinning(count: int) -> int:
    """Of so many points every n-th one is shown, so that there are at most ``MAX_POINTS``."""
    return max(1, -(-count // MAX_POINTS))


def thinned(points: MapPoints) -> MapPoints:
    """Every n-th point; see ``thinning``."""
    step = thinning(len(points.xyz))
    measured = None if points.measured is None else points.measured[::step]
    return MapPoints(points.xyz[::step], points.rgb[::step], points.label[::step], points.confidence[::step], measured)


def pack_points(points: MapPoints, rgb: UInt8) -> bytes:
    """Records of ``POINT``, with colours (N, 3)."""
    packed = np.zeros(len(points.xyz), POINT)
    for column, axis in enumerate(("x", "y", "z")):
        packed[axis] = points.xyz[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        packed[name] = rgb[:, column]
    packed["alpha"] = 255
    packed["label"] = points.label
    packed["confidence"] = np.rint(points.confidence * 255)
    packed["measured"] = 1 if points.measured is None else points.measured
    return packed.tobytes()


def describe_map(snapshot: MapSnapshot, count: int, stamp_ns: int) -> dict[str, Any]:
    """What a map is, for JSON.

    Args:
        snapshot: Of it.
        count: Its points, before thinning.
        stamp_ns: Of the newest frame that was heard of.
    """
    labels = snapshot.label_set
    classes = zip(labels.ids, labels.names, labels.colors, strict=True)
    return {
        "stamp_ns": stamp_ns,
        "version": snapshot.version,
        "epoch": snapshot.epoch,
        "voxel_size_m": snapshot.voxel_size_m,
        "scale_known": snapshot.scale_known,
        "points": -(-count // thinning(count)),
        "every_nth": thinning(count),
        "label_set": labels.name,
        "unknown_id": labels.ignore_id,
        "classes": [{"id": i, "name": name, "color": list(color)} for i, name, color in classes],
    }


def describe_pose(frame: PosedFrame, T_map_camera: Float64 | None) -> dict[str, Any]:
    """Where a frame was taken in the map (None = that is not known), and with which lens, for JSON."""
    k = frame.intrinsics
    return {
        "stamp_ns": frame.stamp_ns,
        "seq": frame.seq,
        "camera": frame.camera_id,
        "T_map_camera": None if T_map_camera is None else T_map_camera.tolist(),
        "intrinsics": {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": k.width, "height": k.height},
        "pose_source": frame.pose_source,
    }


def moving_mask(update: MapUpdate) -> UInt8:
    """255 (H, W) where something moves, which the map leaves out; else 0."""
    none = np.zeros(update.label.shape, np.uint8)
    return none if update.moving is None else np.where(update.moving, np.uint8(255), none)


def to_jpeg(rgb: UInt8) -> bytes:
    """JPEG file of an image (H, W, 3)."""
    return _encoded(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])


def to_png(image: UInt8) -> bytes:
    """PNG file of an image (H, W, 3) or of one channel (H, W); little compressed, for speed."""
    turned = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    return _encoded(".png", turned, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _encoded(kind: str, image: Any, flags: list[int]) -> bytes:
    done, data = cv2.imencode(kind, image, flags)
    if not done:
        raise FrameError(f"an image of shape {image.shape} cannot be written as {kind}")
    return data.tobytes()
