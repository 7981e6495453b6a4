"""What ``refine`` learns from: procedural rooms or own labelled logs are mapped, and their surfaces and labels kept.

Labels are those of the images, at the voxels that the rays of their pixels meet: nothing in 3D is labelled by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.benchmark.config import MAP_WIDTH, SequenceConfig, camera_of_width
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.fields.sparse_conv import find_rows, pack_cells
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES, LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.refine import surface_voxels, up_frame
from semantic_mapper.mapping.storage.block_index import KEY_LIMIT
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.room_map import UP
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig
from semantic_mapper.scenes.sequence import room_views
from semantic_mapper.training.nesf import TrainingMap
from semantic_mapper.types import Float64, PosedFrame

ROOM_FRAMES = 32
AGREE_M = 0.1  # a hit farther from what the frame measured speaks of another surface

_log = get_logger(__name__)


def make_room_maps(
    seeds: Iterable[int],
    folder: Path,
    weights: Path | None = None,
    frames: int = ROOM_FRAMES,
    on_room: Callable[[int], object] = lambda seed: None,
    rendered: Sequence[int] = (1,),
) -> list[Path]:
    """Map procedural rooms that are not yet in the folder; returns the files of all of them.

    Args:
        seeds: Of the rooms; the field that maps must not have been trained on them, or its votes are too sure.
        folder: Is made if it is missing.
        weights: Of the field; None = those that ship.
        frames: Of 320x240 a room.
        on_room: Called after each.
        rendered: Maps of each room: every so many-th frame is rendered, the others have no votes.
    """
    paths: list[Path] = []
    for seed in seeds:
        files = {every: folder / f"room-{seed}{'' if every == 1 else f'-every-{every}'}.npz" for every in rendered}
        missing = {every: path for every, path in files.items() if not path.is_file()}
        if missing:
            walk = CameraPathConfig(step_m=SequenceConfig().step_m)
            views = list(room_views(seed, frames, camera_of_width(MAP_WIDTH), path=walk, noise=NoiseConfig()))
            instances = [view.rendered.instance for view in views]
            for every, path in missing.items():
                voxel_map = _map_frames((view.frame for view in views), seen := [], weights, every)
                training_map(voxel_map, seen, ROOMS, UP, instances=instances).save(path)
        paths += files.values()
        on_room(seed)
    return paths


def make_log_maps(logs: Iterable[Path], folder: Path, weights: Path | None = None) -> list[Path]:
    """Map labelled logs with depth that are not yet in the folder; those that teach nothing are left out, and told.

    Raises:
        ConfigError: no log is left.
        LogError: a log cannot be read.
    """
    paths: list[Path] = []
    left_out: dict[str, str] = {}
    for log in logs:
        path = folder / f"log-{log.stem}.npz"
        reason = "" if path.is_file() else _map_log(log, path, weights)
        if reason:
            left_out[str(log)] = reason
            _log.warning("log_left_out", log=str(log), reason=reason)
        else:
            paths.append(path)
    if not paths:
        told = "; ".join(f"{log}: {reason}" for log, reason in left_out.items())
        raise ConfigError(f"none of {len(left_out)} logs can be learned from ({told})")
    return paths


def _map_log(log: Path, path: Path, weights: Path | None) -> str:
    """Map a log and write its file; or why it teaches nothing."""
    with open_log(log) as reader:
        labels = reader.info.label_set
        if labels is None:
            return "it has no labels"
        if not reader.info.scale_known:
            return "its lengths are not metres"
        voxel_map = _map_frames(reader, seen := [], weights)
    if not seen:
        return "no labelled frame has depth"
    try:
        training_map(voxel_map, seen, labels).save(path)
    except MapError as error:
        return str(error)
    return ""


def _map_frames(
    frames: Iterable[PosedFrame], seen: list[PosedFrame], weights: Path | None, rendered: int = 1
) -> VoxelMap:
    """The map of the frames with depth; those of them with labels come into ``seen``."""
    pipeline = Mapper.load(weights).pipeline
    for number, frame in enumerate(frames):
        if frame.depth_m is None:
            continue
        if number % rendered:
            pipeline.voxel_map.integrate(frame, frame.depth_m, None)
        else:
            pipeline.step(replace(frame, label=None))
        if frame.label is not None:
            seen.append(frame)
    return pipeline.voxel_map


def training_map(
    voxel_map: VoxelMap,
    frames: Sequence[PosedFrame],
    labels: LabelSet,
    up: Float64 | None = None,
    *,
    instances: Sequence[NDArray[np.integer[Any]]] | None = None,
) -> TrainingMap:
    """Cast the labelled pixels of frames into a map.

    Args:
        voxel_map: In the frames' world, of at least one block.
        frames: With labels, ids of ``labels``; where one has depth, hits that it contradicts do not count.
        labels: Their classes; taken over by name.
        up: (3,) in the world; None = away from the floor.
        instances: (H, W) of each frame, the same number where the same object is, 0 = none; None = not known.

    Raises:
        MapError: up cannot be found.
    """
    things = np.isin(voxel_map.label_set.ids, voxel_map.label_set.thing_ids(STUFF_NAMES))
    every = np.full(3, KEY_LIMIT)
    voxels = surface_voxels(voxel_map, up_frame(voxel_map, up), -every, every)
    keys = pack_cells(voxels.voxel[voxels.core])
    order = np.argsort(keys)
    table = voxel_map.label_set.channel_map_from(labels)
    packed: list[NDArray[np.int64]] = []
    for frame, instance in zip(frames, instances or [None] * len(frames), strict=True):
        assert frame.label is not None
        cast = voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics)
        channel = table[frame.label]
        hit = (cast.depth_m > 0) & (channel >= 0)
        if frame.depth_m is not None:
            hit &= (frame.depth_m <= 0) | (np.abs(frame.depth_m - cast.depth_m) < AGREE_M)
        xyz = transform(frame.T_world_camera, unproject(cast.depth_m, frame.intrinsics)[hit])
        row = find_rows(keys[order], pack_cells(np.rint(xyz / voxel_map.config.voxel_size_m).astype(np.int64)))
        number = np.zeros(len(row), np.int64) if instance is None else instance[hit] * things[channel[hit]]
        on = row < len(keys)
        packed.append((order[row[on]] << 24) | (channel[hit][on] << 16) | number[on])
    found, count = np.unique(np.concatenate(packed), return_counts=True)
    return TrainingMap(
        points=voxels.points.rows(voxels.core),
        row=found >> 24,
        channel=(found >> 16) & 255,
        instance=found & 0xFFFF,
        count=count.astype(np.float32),
    )
