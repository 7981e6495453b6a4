"""Measure a long walk through a building: whether a step costs in the last minute what it did in the first."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from research.scenes import CameraPathConfig, Visit, building_walk
from semantic_mapper.config import MapperConfig
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.block_grid import advised_mb
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.memory import give_back_freed_memory
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

WARM_UP = 5  # frames that do not count: compiling
SETTLED_MINUTE = 5  # by then every buffer has its size; memory that grows later is lost
SLOPE_MINUTES = 10  # a slope over less of a walk is noise
COMPARED_MINUTES = 10  # at the beginning, from the settled minute on, and at the end
_READ_AT_ONCE = 512  # blocks


@dataclass(frozen=True, slots=True)
class WalkPlan:
    """The walk of ``bench_walk``.

    Args:
        rooms: Of the building.
        returns: Of them visited a second time, at the end.
        minutes: By the frames' stamps, shared out evenly among the visits.
        hz: Frames a second.
        width: Of the images, 4 : 3.
        speed_m_per_s: Of the camera.
    """

    rooms: int = 30
    returns: int = 6
    minutes: float = 60.0
    hz: float = 2.0
    width: int = 320
    speed_m_per_s: float = 0.4

    @property
    def frames_a_visit(self) -> int:
        """Frames of each visit."""
        return max(1, round(self.minutes * 60 * self.hz / (self.rooms + self.returns)))

    @property
    def frames(self) -> int:
        """Of the whole walk."""
        return self.frames_a_visit * (self.rooms + self.returns)

    def visits(self) -> Iterator[Visit]:
        """The walk itself."""
        path = CameraPathConfig(step_m=self.speed_m_per_s / self.hz)
        camera = wide_camera(self.width)
        return building_walk(self.rooms, self.frames_a_visit, camera, returns=self.returns, hz=self.hz, path=path)


def wide_camera(width: int) -> CameraIntrinsics:
    """The lens of the 640x480 benchmarks at another width, 4 : 3."""
    scale, height = width / 640, width * 3 // 4
    return CameraIntrinsics(525.0 * scale, 525.0 * scale, (width - 1) / 2, (height - 1) / 2, width, height)


def bench_walk(
    weights: Path | None, config: MapperConfig, plan: WalkPlan, on_frame: Callable[[int], None] = lambda _: None
) -> dict[str, Any]:
    """Map the whole walk with ``MappingPipeline.step`` and measure each step, and memory after it.

    Args:
        weights: None = those that ship with the package.
        config: Of the mapper.
        plan: The walk.
        on_frame: Called with how many frames are done.

    Returns:
        Plain data, flat. Lists named ``minute_*`` have one value for each minute of the walk (by stamps). ``step_*`` is
        time on the clock; ``cpu_*`` processor time of the same steps, which other programs disturb less; ``fuse_*``
        fusion alone; ``*_slope_percent_a_minute`` the least squares slope over the run, of the mean, None of a walk of
        less than ``SLOPE_MINUTES``. ``*_p50_first_ten_minutes_ms`` are medians from minute 5 to 15, to compare with
        ``*_p50_last_ten_minutes_ms``, None where the walk is too short for both.
        ``return_cpu_ratio`` is the median step of the visits at the end over that of the very same frames the first
        time. ``rss_*`` is resident memory of the process, which gives back what it has freed once a minute of the walk,
        as the mapper node does: at most in the first and last minute, in minute 5, when all buffers have their size, in
        any later one and in any at all; its growth is that from minute 5 to the last, None of a walk too short for
        that. ``blocks_*`` and ``store_mb`` are the map in memory and on disk;
        ``frame_mb_at_most`` is what the blocks take that one frame touches: with a smaller limit on memory than
        ``memory_advised_mb`` frames push the blocks of the last one to disk, with a smaller one than this their own.
        ``returns_unchanged`` says how many of ``returns`` rooms had, bit for bit, the blocks that they had when they
        were left. ``minute_miou`` scores the rendered labels, in rooms that the weights may have been trained
        on: for drift, not for rank.
    """
    began = time.perf_counter()
    pipeline = Mapper.load(weights, config).pipeline
    log, left = _StepLog(pipeline, plan.frames_a_visit), {}
    unchanged = 0
    for visit in plan.visits():
        entered = pipeline.voxel_map.version
        if visit.returning:
            keys, digest = left[visit.room]
            unchanged += _digest(pipeline.voxel_map, keys) == digest
        for frame in visit.frames:
            log.note(visit, frame, *timed_step(pipeline, frame))
            on_frame(log.frames)
        if not visit.returning and visit.room < plan.returns:
            keys = pipeline.voxel_map.changes(entered).keys
            left[visit.room] = keys, _digest(pipeline.voxel_map, keys)
    return {
        "rooms": plan.rooms,
        "returns": plan.returns,
        "returns_unchanged": unchanged,
        "minutes": plan.minutes,
        "hz": plan.hz,
        "frames": plan.frames,
        "size": f"{plan.width}x{plan.width * 3 // 4}",
        "quality": config.quality,
        "voxel_size_m": config.voxel_map.voxel_size_m,
        "memory_mb": config.voxel_map.memory_mb,
        "classes": len(pipeline.label_set),
        "threads": torch.get_num_threads(),
        "wall_s": round(time.perf_counter() - began, 1),
        **log.figures(config.voxel_map.memory_mb),
    }


def resident_mb() -> float:
    """Memory of this process that is in RAM, MB (Linux)."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.split("VmRSS:")[1].split()[0]) * 1024 / 1e6


def slope_percent(minutes: NDArray[np.float64], values: NDArray[np.float64]) -> float | None:
    """Least squares slope of values against minutes, in percent of their mean a minute; None of a short run."""
    if round(float(np.ptp(minutes))) < SLOPE_MINUTES:
        return None
    return round(float(100 * np.polyfit(minutes, values, 1)[0] / np.mean(values)), 3)


def first_and_last(minutes: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[float | None, float | None]:
    """Medians of the first ``COMPARED_MINUTES`` from the settled one on, and of the last; None where these overlap."""
    end = float(minutes.max())
    if round(end) < SETTLED_MINUTE + 2 * COMPARED_MINUTES:
        return None, None
    first = (minutes >= SETTLED_MINUTE) & (minutes < SETTLED_MINUTE + COMPARED_MINUTES)
    last = minutes > end - COMPARED_MINUTES
    return round(float(np.median(values[first])), 1), round(float(np.median(values[last])), 1)


def timed_step(pipeline: MappingPipeline, frame: PosedFrame) -> tuple[MapUpdate, float, float]:
    """What the step gave, and its milliseconds on the clock and of processor time."""
    began, worked = time.perf_counter(), time.process_time()
    update = pipeline.step(frame)
    return update, (time.perf_counter() - began) * 1e3, (time.process_time() - worked) * 1e3


@dataclass(slots=True)
class _StepLog:
    """What each step took and left behind."""

    pipeline: MappingPipeline
    frames_a_visit: int
    frames: int = 0
    rows: list[tuple[float, ...]] = field(default_factory=list)  # as _COLUMNS
    confusions: list[ConfusionMatrix] = field(default_factory=list)  # of each minute

    def note(self, visit: Visit, frame: PosedFrame, update: MapUpdate, step_ms: float, cpu_ms: float) -> None:
        voxel_map, label_set = self.pipeline.voxel_map, self.pipeline.label_set
        minute = (frame.stamp_ns - 1) / 60e9  # the first frame comes one period after 0
        while len(self.confusions) <= int(minute):
            self.confusions.append(ConfusionMatrix(label_set))
            give_back_freed_memory()
        assert frame.label is not None
        truth = label_set.to_ids(label_set.channel_map_from(ROOMS)[frame.label])
        self.confusions[int(minute)].update(truth, update.label, f"frame {frame.seq}")
        stored = voxel_map.stored_blocks
        with voxel_map.locked() as grid:
            stored_bytes = grid.stored_bytes
        self.rows.append(
            (
                minute,
                visit.room if visit.returning else -1,
                step_ms,
                cpu_ms,
                update.stage_ms["fuse"],
                resident_mb(),
                voxel_map.block_count - stored,
                stored,
                stored_bytes / 1e6,
                len(self.pipeline.keyframes),
                len(update.source_seqs),
                update.blocks_touched,
            )
        )
        self.frames += 1

    def figures(self, memory_mb: int) -> dict[str, Any]:
        table = dict(zip(_COLUMNS, np.array(self.rows).T, strict=True))
        counted = {name: values[WARM_UP:] if len(self.rows) > 2 * WARM_UP else values for name, values in table.items()}
        by_minute = [counted["minute"].astype(int) == m for m in range(int(table["minute"][-1]) + 1)]
        by_minute = [of for of in by_minute if of.any()]
        rss = [float(counted["rss_mb"][of].max()) for of in by_minute]
        scores = [confusion.metrics().miou for confusion in self.confusions]
        most_touched = int(table["blocks_touched"].max())
        with self.pipeline.voxel_map.locked() as grid:
            block_bytes = grid.block_bytes

        def minutely(name: str, of: Callable[[NDArray[np.float64]], Any], digits: int = 1) -> list[float]:
            return [round(float(of(counted[name][rows])), digits) for rows in by_minute]

        return {
            "step_p50_ms": round(float(np.percentile(counted["step_ms"], 50)), 1),
            "step_p95_ms": round(float(np.percentile(counted["step_ms"], 95)), 1),
            "cpu_p50_ms": round(float(np.percentile(counted["cpu_ms"], 50)), 1),
            "fuse_p50_ms": round(float(np.percentile(counted["fuse_ms"], 50)), 2),
            **_drift(counted),
            "return_cpu_ratio": self._return_ratio(table),
            **_memory(rss, memory_mb),
            "frame_mb_at_most": round(most_touched * block_bytes / 1e6, 1),
            "memory_advised_mb": advised_mb(most_touched, block_bytes),
            "blocks": int(table["blocks_in_memory"][-1] + table["blocks_on_disk"][-1]),
            "blocks_in_memory_at_most": int(table["blocks_in_memory"].max()),
            "blocks_on_disk": int(table["blocks_on_disk"][-1]),
            "store_mb": round(float(table["store_mb"][-1]), 1),
            "keyframes": int(table["keyframes"][-1]),
            "minute_step_p50_ms": minutely("step_ms", np.median),
            "minute_step_p95_ms": minutely("step_ms", lambda v: np.percentile(v, 95)),
            "minute_cpu_p50_ms": minutely("cpu_ms", np.median),
            "minute_fuse_p50_ms": minutely("fuse_ms", np.median, 2),
            "minute_rss_mb": [round(v, 1) for v in rss],
            "minute_blocks_in_memory": minutely("blocks_in_memory", np.max, 0),
            "minute_blocks_on_disk": minutely("blocks_on_disk", np.max, 0),
            "minute_store_mb": minutely("store_mb", np.max),
            "minute_keyframes": minutely("keyframes", np.max, 0),
            "minute_source_views": minutely("source_views", np.mean, 2),
            "minute_miou": [None if score is None else round(score, 4) for score in scores],
        }

    def _return_ratio(self, table: dict[str, NDArray[np.float64]]) -> float | None:
        """Median processor time of the visits at the end over that of the same frames the first time."""
        back = np.flatnonzero(table["returning_to"] >= 0)
        if not len(back):
            return None
        within = (back - back[0]) % self.frames_a_visit
        first = (table["returning_to"][back] * self.frames_a_visit + within).astype(int)
        ratio = np.median(table["cpu_ms"][back]) / np.median(table["cpu_ms"][first])
        return round(float(ratio), 3)


def _drift(counted: dict[str, NDArray[np.float64]]) -> dict[str, float | None]:
    """What tells whether steps get dearer as the walk goes on."""
    minutes, found = counted["minute"], {}
    for name in ("step", "cpu", "fuse"):
        found[f"{name}_slope_percent_a_minute"] = slope_percent(minutes, counted[f"{name}_ms"])
    for name in ("step", "cpu"):
        first, last = first_and_last(minutes, counted[f"{name}_ms"])
        found |= {f"{name}_p50_first_ten_minutes_ms": first, f"{name}_p50_last_ten_minutes_ms": last}
    return found


def _memory(rss: list[float], memory_mb: int) -> dict[str, float | None]:
    """Figures of resident memory, from the most of each minute, MB."""
    settled = rss[SETTLED_MINUTE] if len(rss) > SETTLED_MINUTE + 1 else None
    growth = None if settled is None else rss[-1] - settled
    return {
        "rss_first_minute_mb": round(rss[0], 1),
        "rss_minute_5_mb": None if settled is None else round(settled, 1),
        "rss_max_after_minute_5_mb": None if settled is None else round(max(rss[SETTLED_MINUTE + 1 :]), 1),
        "rss_last_minute_mb": round(rss[-1], 1),
        "rss_max_mb": round(max(rss), 1),
        "rss_growth_mb": None if growth is None else round(growth, 1),
        "rss_growth_percent_of_limit": None if not memory_mb or growth is None else round(100 * growth / memory_mb, 1),
    }


_COLUMNS: tuple[str, ...] = (
    "minute",
    "returning_to",
    "step_ms",
    "cpu_ms",
    "fuse_ms",
    "rss_mb",
    "blocks_in_memory",
    "blocks_on_disk",
    "store_mb",
    "keyframes",
    "source_views",
    "blocks_touched",
)


def _digest(voxel_map: VoxelMap, keys: NDArray[np.int32]) -> str:
    """SHA-256 of everything in existing blocks (B, 3)."""
    total = hashlib.sha256()
    for start in range(0, len(keys), _READ_AT_ONCE):
        for values in voxel_map.block_state(keys[start : start + _READ_AT_ONCE]).values():
            total.update(np.ascontiguousarray(values).tobytes())
    return total.hexdigest()
