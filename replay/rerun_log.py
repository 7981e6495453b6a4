"""Rerun recording (.rrd) of a session: images, rendered semantics, camera path, and the map at the end."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import rerun as rr

from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import MapUpdate, PosedFrame

IMAGE_WIDTH = 320  # images are logged at this width: a recording of a long log stays small
JPEG_QUALITY = 80


class RerunLog:
    """Writes one .rrd file; open it with ``rerun FILE``."""

    def __init__(self, path: Path, label_set: LabelSet) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._label_set = label_set
        self._stream = rr.RecordingStream("semantic_mapper")
        self._stream.save(path)
        infos = [
            rr.AnnotationInfo(id=i, label=name, color=color)
            for i, name, color in zip(label_set.ids, label_set.names, label_set.colors, strict=True)
        ]
        infos.append(rr.AnnotationInfo(id=label_set.ignore_id, label="unknown", color=(0, 0, 0)))
        self._stream.log("/", rr.AnnotationContext(infos), static=True)
        self._path: list[np.ndarray] = []

    def log_step(self, frame: PosedFrame, update: MapUpdate) -> None:
        """One frame and what was rendered for it."""
        scale = min(1.0, IMAGE_WIDTH / frame.intrinsics.width)
        size = (round(frame.intrinsics.width * scale), round(frame.intrinsics.height * scale))
        k = frame.intrinsics
        self._stream.set_time("capture", duration=np.timedelta64(frame.stamp_ns, "ns"))
        self._stream.set_time("frame", sequence=frame.seq)
        T = frame.T_world_camera
        self._stream.log("world/camera", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._stream.log(
            "world/camera/image",
            rr.Pinhole(
                focal_length=(k.fx * scale, k.fy * scale),
                principal_point=((k.cx + 0.5) * scale, (k.cy + 0.5) * scale),
                width=size[0],
                height=size[1],
                camera_xyz=rr.ViewCoordinates.RDF,
            ),
        )
        rgb = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
        self._stream.log(
            "world/camera/image/rgb", rr.Image(np.asarray(rgb, np.uint8)).compress(jpeg_quality=JPEG_QUALITY)
        )
        label = cv2.resize(update.label, size, interpolation=cv2.INTER_NEAREST_EXACT)
        self._stream.log("world/camera/image/semantics", rr.SegmentationImage(np.asarray(label, np.uint8)))
        depth = cv2.resize(update.depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT)
        self._stream.log("world/camera/image/depth", rr.DepthImage(np.asarray(depth, np.float32), meter=1.0))
        self._path.append(T[:3, 3].copy())
        for stage, value in update.stage_ms.items():
            self._stream.log(f"stage_ms/{stage}", rr.Scalars(value))

    def finish(self, points: MapPoints) -> None:
        """The finished map, coloured by class and by camera colour."""
        if self._path:
            self._stream.log("world/path", rr.LineStrips3D([np.stack(self._path)]))
        colors = self._label_set.colorize(points.label)
        self._stream.log("world/map/semantic", rr.Points3D(points.xyz, colors=colors, radii=0.01))
        self._stream.log("world/map/colour", rr.Points3D(points.xyz, colors=points.rgb, radii=0.01))
        self._stream.flush()
        self._stream.disconnect()
