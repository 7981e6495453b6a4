"""A log as a Rerun recording: colour, depth, labels and the path of the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.replay.exporters.base import ExportFrame
from semantic_mapper.replay.exporters.rerun_log import RerunLog, recording_file
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import MapUpdate, PosedFrame


class RerunExporter:
    """Writes one file, with the writer that draws sessions.

    Args:
        path: Of the file.
        info: Of the log.
    """

    def __init__(self, path: Path, info: StreamInfo) -> None:
        self.notices: list[str] = []
        self._label_set = info.label_set or make_label_set("none", ["no class"])
        self._told_pseudo = self._told_computed = False
        self._log = RerunLog(recording_file(path), self._label_set)
        self._log.note_scale(info.scale_known)

    def add(self, item: ExportFrame) -> None:
        """Draw one frame."""
        if item.frame.label_is_pseudo and not self._told_pseudo:
            self._told_pseudo = True
            self._log.note("labels", "pseudo labels, which weights have rendered: no truth")
            self.notices.append("labels are pseudo labels, at least of some frames; the entity `labels` says so")
        if item.frame.depth_sigma_m is not None and not self._told_computed:
            self._told_computed = True
            self._log.note("depth", "computed, not a sensor's, at least of some frames")
            self.notices.append("depth is computed, at least of some frames; the entity `depth` says so")
        self._log.log_step(item.frame, self._as_update(item.frame))

    def finish(self) -> None:
        """Close the file."""
        nothing = MapPoints(
            np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8), np.zeros(0, np.float32)
        )
        self._log.finish(nothing)

    def _as_update(self, frame: PosedFrame) -> MapUpdate:
        """What the log itself says of a frame, where a session has what was rendered."""
        size = (frame.intrinsics.height, frame.intrinsics.width)
        label = frame.label if frame.label is not None else np.full(size, self._label_set.ignore_id, np.uint8)
        depth = frame.depth_m if frame.depth_m is not None else np.zeros(size, np.float32)
        return MapUpdate(
            stamp_ns=frame.stamp_ns,
            seq=frame.seq,
            camera_id=frame.camera_id,
            fused=False,
            is_keyframe=False,
            source_seqs=(),
            label=label,
            confidence=np.zeros(size, np.float32),
            depth_m=depth,
            blocks=0,
            blocks_touched=0,
            stage_ms={},
        )
