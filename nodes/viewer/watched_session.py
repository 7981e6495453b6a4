"""A session that the viewer shows while it maps a log."""

from __future__ import annotations

import time

from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.nodes.viewer.sources import REFRESH_S, Begin, MapShow
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.replay.rerun_log import RerunLog
from semantic_mapper.types import MapUpdate, PosedFrame

# Mapping goes before showing: images so often, and between two maps so many times as long as the last one took.
IMAGE_S, PAUSE = 0.5, 20.0


class WatchedSession(RerunLog):
    """Shows frames now and then, the map now and then and at the end, in some twentieth of the time."""

    def __init__(self, begin: Begin, pipeline: MappingPipeline) -> None:
        super().__init__(begin(), pipeline.label_set, pipeline.voxel_map.config.voxel_size_m)
        self._map = pipeline.voxel_map
        self._show, self._mirror = MapShow(self), MapMirror.of(self._map)
        self._image_due, self._map_due = 0.0, time.monotonic() + REFRESH_S
        self._stamp_ns = 0

    def log_step(self, frame: PosedFrame, update: MapUpdate) -> None:
        """One frame and what was rendered for it, and the map, where it is time for them."""
        self._stamp_ns, now = frame.stamp_ns, time.monotonic()
        if now >= self._image_due:
            super().log_step(frame, update)
            self._image_due = now + IMAGE_S
        if now >= self._map_due:
            self._show_map()
            self._map_due = time.monotonic() + max(REFRESH_S, PAUSE * (time.monotonic() - now))

    def finish(self, points: MapPoints, graph: SceneGraph | None = None) -> None:
        """The map as it is at the end; all has been sent then."""
        self._show_map()
        if graph is not None:
            self.log_graph(graph)
        self.close()

    def _show_map(self) -> None:
        self._show.show(self._mirror.apply(self._map.changes(self._mirror.version)), self._stamp_ns)
