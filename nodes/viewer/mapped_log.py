"""A log that is mapped while the viewer shows it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from semantic_mapper.config import MapperConfig
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.viewer.sources import Begin, MapShow
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.replay.rerun_log import RerunLog
from semantic_mapper.replay.session import MapSession
from semantic_mapper.types import PosedFrame


def show_log(
    path: Path,
    weights: Path | None,
    config: MapperConfig,
    frames: int,
    begin: Begin,
    refresh_s: float,
    going: Callable[[], bool],
    monitor: JobMonitor,
) -> None:
    """Map a log, at most ``frames`` of it (0 = all), and show it meanwhile, its map every ``refresh_s`` and at the end.

    ``begin`` is called once log and weights are open; it goes on while ``going()``. Raises LogError, WeightsError,
    ConfigError, MapError: it cannot be mapped.
    """
    mapper = Mapper.load(weights, config)
    pipeline = mapper.pipeline
    voxel_map = pipeline.voxel_map
    with open_log(path) as reader:
        log = RerunLog(begin(), pipeline.label_set, voxel_map.config.voxel_size_m)
        show, mirror = MapShow(log), MapMirror.of(voxel_map)
        session = MapSession(
            mapper, stream_labels=None, source=reader.info.source, scale_known=reader.info.scale_known, rerun=log
        )
        total = min(len(reader), frames or len(reader))
        monitor.start(total)
        shown_at, stamp_ns = time.monotonic(), 0
        for done, item in enumerate(reader.frames_or_errors(total), 1):
            if not going():
                break
            if isinstance(item, PosedFrame):
                session.process(item)
                stamp_ns = item.stamp_ns
            else:
                session.refuse(done - 1, 0, str(item))
            monitor.set(done)
            if time.monotonic() - shown_at > refresh_s:
                show.show(mirror.apply(voxel_map.changes(mirror.version)), stamp_ns)
                shown_at = time.monotonic()
        show.show(mirror.apply(voxel_map.changes(mirror.version)), stamp_ns)
        log.close()
