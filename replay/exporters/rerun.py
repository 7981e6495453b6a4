"""A log as a Rerun recording (.rrd)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.replay.exporters.base import ExportFrame
from semantic_mapper.replay.rerun_log import RerunLog, recording_file
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import MapUpdate


class RerunExporter:
    """Writes one file, with the writer that draws sessions."""

    def __init__(self, path: Path, info: StreamInfo) -> None:
        self.notices: list[str] = []
        self._label_set = info.label_set or make_label_set("none", ["no class"])
        self._noted: set[str] = set()
        self._log = RerunLog(recording_file(path), self._label_set)
        self._log.note_scale(info.scale_known)

    def add(self, item: ExportFrame) -> None:
        """Draw one frame: what the log itself says of it, where a session has what was rendered."""
        frame = item.frame
        if frame.label_is_pseudo:
            self._note("labels", "pseudo labels, which weights have rendered: no truth")
        if frame.depth_sigma_m is not None:
            self._note("depth", "computed, not a sensor's")
        size = (frame.intrinsics.height, frame.intrinsics.width)
        update = MapUpdate(
            stamp_ns=frame.stamp_ns,
            seq=frame.seq,
            camera_id=frame.camera_id,
            fused=False,
            is_keyframe=False,
            source_seqs=(),
            label=np.full(size, self._label_set.ignore_id, np.uint8) if frame.label is None else frame.label,
            confidence=np.zeros(size, np.float32),
            depth_m=np.zeros(size, np.float32) if frame.depth_m is None else frame.depth_m,
            blocks=0,
            blocks_touched=0,
            stage_ms={},
        )
        self._log.log_step(frame, update)

    def _note(self, name: str, text: str) -> None:
        if name not in self._noted:
            self._noted.add(name)
            self._log.note(name, f"{text}, at least of some frames")
            self.notices.append(f"{name}: {text}, at least of some frames; the entity `{name}` says so")

    def finish(self) -> None:
        """Draw the way of each camera, and close the file."""
        nothing = np.zeros((0, 3), np.float32)
        self._log.finish(MapPoints(nothing, nothing.astype(np.uint8), np.zeros(0, np.uint8), np.zeros(0, np.float32)))
