"""Maps with labelled hits, which ``refine`` learns from: procedural rooms or own labelled logs, mapped and kept.

Each map is a pair of files in one folder: ``NAME.npz``, the map as ``replay`` would save it, and ``NAME.hits.npz``, the
voxels that rays of labelled pixels meet. Labels are those of the images: nothing in 3D is labelled by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.benchmark.config import MAP_WIDTH, SequenceConfig, camera_of_width
from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.files import atomic_write
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig, room_frames
from semantic_mapper.types import PosedFrame

ROOM_FRAMES = 32
AGREE_M = 0.1  # a hit farther from what the frame measured speaks of another surface
HITS_SUFFIX = ".hits.npz"

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class LabelledHits:
    """Where rays of labelled pixels meet a map.

    Args:
        voxel: (N, 3) int32, the voxel nearest to the hit.
        channel: (N,) uint8 class channel of the map's label set; a voxel may come with several.
        count: (N,) uint16 pixels.
    """

    voxel: NDArray[np.int32]
    channel: NDArray[np.uint8]
    count: NDArray[np.uint16]


def make_room_maps(
    seeds: Iterable[int],
    folder: Path,
    weights: Path | None = None,
    frames: int = ROOM_FRAMES,
    on_room: Callable[[int], object] = lambda seed: None,
) -> list[Path]:
    """Map procedural rooms that are not yet in the folder; returns the files of all of them.

    Args:
        seeds: Of the rooms; the field that maps must not have been trained on them, or its votes are too sure.
        folder: Is made if it is missing.
        weights: Of the field; None = those that ship.
        frames: Of 320x240 a room.
        on_room: Called after each.
    """
    paths: list[Path] = []
    for seed in seeds:
        path = folder / f"room-{seed}.npz"
        if not path.with_suffix(HITS_SUFFIX).is_file():
            walk = CameraPathConfig(step_m=SequenceConfig().step_m)
            views = room_frames(seed, frames, camera_of_width(MAP_WIDTH), path=walk, noise=NoiseConfig())
            _map_frames(views, ROOMS, path, weights, MapperConfig())
        paths.append(path)
        on_room(seed)
    return paths


def make_log_maps(logs: Iterable[Path], folder: Path, weights: Path | None = None) -> list[Path]:
    """Map labelled logs with depth that are not yet in the folder; logs without labels or depth are left out.

    Raises:
        ConfigError: no log is left.
        LogError: a log cannot be read.
    """
    paths: list[Path] = []
    left_out = 0
    for log in logs:
        path = folder / f"log-{log.stem}.npz"
        if not path.with_suffix(HITS_SUFFIX).is_file():
            with open_log(log) as reader:
                labels, usable = reader.info.label_set, reader.info.scale_known
                mapped = labels is not None and usable and _map_frames(iter(reader), labels, path, weights, MapperConfig())
            if not mapped:
                left_out += 1
                _log.warning("log_left_out", log=str(log), reason="no labelled frames with depth")
                continue
        paths.append(path)
    if not paths:
        raise ConfigError(f"none of {left_out} logs has labelled frames with depth; `semantic-mapper info` shows what has")
    return paths


def read_hits(path: Path) -> LabelledHits:
    """The hits that belong to the map in ``path``."""
    with np.load(path.with_suffix(HITS_SUFFIX)) as stored:
        return LabelledHits(stored["voxel"].astype(np.int32), stored["channel"], stored["count"])


def _map_frames(
    frames: Iterable[PosedFrame], labels: LabelSet, path: Path, weights: Path | None, config: MapperConfig
) -> bool:
    """Map frames with depth and write both files; False, and no files, where none of them has labels."""
    pipeline = Mapper.load(weights, config).pipeline
    seen: list[PosedFrame] = []
    for frame in frames:
        if frame.depth_m is None:
            continue
        pipeline.step(replace(frame, label=None))
        if frame.label is not None:
            seen.append(frame)
    if not seen:
        return False
    hits = labelled_hits(pipeline.voxel_map, seen, labels)
    path.parent.mkdir(parents=True, exist_ok=True)
    pipeline.voxel_map.save(path)
    with atomic_write(path.with_suffix(HITS_SUFFIX)) as file:
        np.savez_compressed(file, voxel=hits.voxel.astype(np.int16), channel=hits.channel, count=hits.count)
    return True


def labelled_hits(voxel_map: VoxelMap, frames: Iterable[PosedFrame], labels: LabelSet) -> LabelledHits:
    """Cast the labelled pixels of frames into a map.

    Args:
        voxel_map: In the frames' world.
        frames: With labels, ids of ``labels``; where one has depth, hits that it contradicts do not count.
        labels: Their classes; taken over by name.
    """
    table = voxel_map.label_set.channel_map_from(labels)
    rows: list[NDArray[np.int64]] = []
    for frame in frames:
        assert frame.label is not None
        cast = voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics)
        channel = table[frame.label]
        hit = (cast.depth_m > 0) & (channel >= 0)
        if frame.depth_m is not None:
            hit &= (frame.depth_m <= 0) | (np.abs(frame.depth_m - cast.depth_m) < AGREE_M)
        xyz = transform(frame.T_world_camera, unproject(cast.depth_m, frame.intrinsics)[hit])
        voxel = np.rint(xyz / voxel_map.config.voxel_size_m).astype(np.int64)
        rows.append(np.column_stack((voxel, channel[hit])))
    found, count = np.unique(np.concatenate(rows), axis=0, return_counts=True)
    return LabelledHits(
        found[:, :3].astype(np.int32), found[:, 3].astype(np.uint8), np.minimum(count, 65535).astype(np.uint16)
    )
