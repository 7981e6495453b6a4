"""A log as MCAP with Foxglove's well-known schemas, JSON encoded: what Foxglove and Lichtblick show without a plugin.

Of each camera: ``/CAMERA/rgb`` (foxglove.CompressedImage, the log's own PNG or JPEG), ``/CAMERA/calibration``
(CameraCalibration), ``/CAMERA/depth`` (RawImage: 16UC1 millimetres where these are exact, else 32FC1 metres),
``/CAMERA/labels`` (CompressedImage, PNG in the colours of the label set), and ``/tf`` (FrameTransform of the camera in
"world"). The schemas are described at https://docs.foxglove.dev/docs/sdk/schemas.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

from semantic_mapper.geometry import camera_matrix
from semantic_mapper.replay.exporters.base import ExportFrame, encoded, quaternion
from semantic_mapper.transport.images import depth_to_uint16
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame

WORLD = "world"
_KINDS = {  # in JSON schemas, of what messages hold
    bytes: {"type": "string", "contentEncoding": "base64"},
    str: {"type": "string"},
    int: {"type": "integer"},
    float: {"type": "number"},
    list: {"type": "array", "items": {"type": "number"}},
}


class FoxgloveExporter:
    """Writes one file; chunks are compressed, which undoes what base64 adds."""

    def __init__(self, path: Path, info: StreamInfo) -> None:
        self.notices: list[str] = []
        self._labels = info.label_set
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(library="semantic-mapper")
        about = {"source": info.source, **info.metadata}
        if info.label_set is not None:
            about["classes"] = ", ".join(info.label_set.names)
        self._writer.add_metadata("semantic-mapper", about)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(self, item: ExportFrame) -> None:
        """Write one frame."""
        frame = item.frame
        head = {"timestamp": _time(frame.stamp_ns), "frame_id": frame.camera_id}
        camera = f"/{frame.camera_id}"
        self._write("/tf", "foxglove.FrameTransform", frame, _transform(frame))
        self._write(f"{camera}/calibration", "foxglove.CameraCalibration", frame, head | _calibration(frame.intrinsics))
        image = head | {"data": item.rgb.data, "format": item.rgb.encoding}
        self._write(f"{camera}/rgb", "foxglove.CompressedImage", frame, image)
        if frame.depth_m is not None:
            name = "depth" if frame.depth_sigma_m is None else "computed_depth"
            self._write(f"{camera}/{name}", "foxglove.RawImage", frame, head | _depth(frame.depth_m))
        if frame.label is not None and self._labels is not None:
            drawn = encoded(self._labels.colorize(frame.label))
            image = head | {"data": drawn.data, "format": drawn.encoding}
            name = "pseudo_labels" if frame.label_is_pseudo else "labels"
            self._write(f"{camera}/{name}", "foxglove.CompressedImage", frame, image)

    def finish(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()
        self._file.close()

    def _write(self, topic: str, schema: str, frame: PosedFrame, message: dict[str, Any]) -> None:
        if schema not in self._schemas:
            described = {"title": schema, **_schema_of(message)}
            self._schemas[schema] = self._writer.register_schema(schema, "jsonschema", msgspec.json.encode(described))
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema])
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=frame.stamp_ns,
            publish_time=frame.stamp_ns,
            sequence=frame.seq & 0xFFFFFFFF,
            data=msgspec.json.encode(message),
        )


def _time(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}


def _schema_of(message: dict[str, Any]) -> dict[str, Any]:
    described = {name: _schema_of(v) if isinstance(v, dict) else _KINDS[type(v)] for name, v in message.items()}
    return {"type": "object", "properties": described}


def _transform(frame: PosedFrame) -> dict[str, Any]:
    T = frame.T_world_camera
    return {
        "timestamp": _time(frame.stamp_ns),
        "parent_frame_id": WORLD,
        "child_frame_id": frame.camera_id,
        "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", quaternion(T).tolist(), strict=True)),
    }


def _calibration(intrinsics: CameraIntrinsics) -> dict[str, Any]:
    K = camera_matrix(intrinsics)
    P = np.hstack((K, np.zeros((3, 1))))
    model = "rational_polynomial" if len(intrinsics.distortion) > 5 else "plumb_bob"
    return {
        "width": intrinsics.width,
        "height": intrinsics.height,
        "distortion_model": model if intrinsics.distortion else "",
        "D": list(intrinsics.distortion),
        "K": K.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": P.ravel().tolist(),
    }


def _depth(depth_m: Float32) -> dict[str, Any]:
    height, width = depth_m.shape
    units = depth_to_uint16(depth_m, 1000.0)
    data = np.ascontiguousarray(depth_m, "<f4") if units is None else units.astype("<u2")
    return {
        "width": width,
        "height": height,
        "encoding": "32FC1" if units is None else "16UC1",
        "step": width * data.itemsize,
        "data": data.tobytes(),
    }
