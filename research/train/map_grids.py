"""What ``refine`` learns from: procedural rooms or own labelled logs are mapped, and their surfaces and labels kept.

Labels are those of the images, at the voxels that the rays of their pixels meet: nothing in 3D is labelled by hand.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.evaluation.room_map import UP
from research.scenes import CameraPathConfig, NoiseConfig
from research.scenes.sequence import room_views
from research.suites.config import MAP_WIDTH, SequenceConfig, camera_of_width
from research.train.nesf import TrainingMap
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.fields.nesf import find_rows, pack_cells
from semantic_mapper.fields.weights import default_checkpoint_path, open_weights
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES, LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.blocks import KEY_LIMIT
from semantic_mapper.mapping.refine import surface_voxels, up_frame
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import Float64, PosedFrame

ROOM_FRAMES = 32
MAKING = 1  # goes up when the same rooms or logs become other training maps
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
    """Map procedural rooms; returns the files of all of them.

    Files that are in the folder are kept, unless they were made of something else: those are made again. Raises
    WeightsError: of ``weights``, or a file in the folder is damaged.

    Args:
        seeds: Of the rooms; the field that maps must not have been trained on them, or its votes are too sure.
        folder: Is made if it is missing.
        weights: Of the field; None = those that ship.
        frames: Of 320x240 a room.
        on_room: Called after each.
        rendered: Maps of each room: every so many-th frame is rendered, the others have no votes.
    """
    field = _field_digest(weights)
    paths: list[Path] = []
    for seed in seeds:
        files = {every: folder / f"room-{seed}{'' if every == 1 else f'-every-{every}'}.npz" for every in rendered}
        made_of = {every: made_of_room(seed, field, frames, every) for every in rendered}
        missing = {every: path for every, path in files.items() if not _is_kept(path, made_of[every])}
        if missing:
            walk = CameraPathConfig(step_m=SequenceConfig().step_m)
            views = list(room_views(seed, frames, camera_of_width(MAP_WIDTH), path=walk, noise=NoiseConfig()))
            instances = [view.rendered.instance for view in views]
            for every, path in missing.items():
                voxel_map = _map_frames((view.frame for view in views), seen := [], weights, every)
                found = training_map(voxel_map, seen, ROOMS, UP, instances=instances)
                replace(found, made_of=made_of[every]).save(path)
        paths += files.values()
        on_room(seed)
    return paths


def make_log_maps(
    logs: Iterable[Path],
    folder: Path,
    weights: Path | None = None,
    on_log: Callable[[Path], object] = lambda log: None,
    stopped: Callable[[], object] = bool,
) -> list[Path]:
    """Map labelled logs with depth; those that teach nothing are left out, with a warning.

    Files that are in the folder are kept, unless they were made of something else: those are made again.

    Args:
        logs: Files, or folders with the parts of one log.
        folder: Is made if it is missing.
        weights: Of the field; None = those that ship.
        on_log: Called after each.
        stopped: Called before every frame; when it says yes, the files so far are returned.

    Raises:
        ConfigError: two logs have the same content, or no log is left.
        LogError: a log cannot be read.
        WeightsError: of ``weights``, or a file in the folder is damaged.
    """
    paths: list[Path] = []
    contents: dict[str, Path] = {}
    left_out: dict[str, str] = {}
    field = _field_digest(weights)
    for log in logs:
        if stopped():
            break
        content = _log_digest(log)
        path = folder / f"log-{log.stem}-{content[:12]}.npz"
        if content in contents:
            raise ConfigError(f"{log} and {contents[content]} are the same log; name it once")
        contents[content] = log
        made_of = _digest_of({"log": content, "weights": field})
        reason = "" if _is_kept(path, made_of) else _map_log(log, path, weights, made_of, stopped)
        if stopped() and not path.is_file():
            break
        if reason:
            left_out[str(log)] = reason
            _log.warning("log_left_out", log=str(log), reason=reason)
        else:
            paths.append(path)
        on_log(log)
    if left_out and not paths:
        reasons = "; ".join(f"{log}: {reason}" for log, reason in left_out.items())
        raise ConfigError(f"none of {len(left_out)} logs can be learned from ({reasons})")
    return paths


def made_of_room(seed: int, field: str, frames: int = ROOM_FRAMES, rendered: int = 1) -> str:
    """``TrainingMap.made_of`` of a room; ``field`` is the SHA-256 of the field's weights file."""
    return _digest_of({"room": seed, "weights": field, "frames": frames, "rendered": rendered})


def _digest_of(what: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps({"making": MAKING, **what}, sort_keys=True).encode()).hexdigest()


def _field_digest(weights: Path | None) -> str:
    path = default_checkpoint_path() if weights is None else weights
    open_weights(path)  # says what is wrong with them
    return _file_digest(path)


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _log_digest(log: Path) -> str:
    """Of the content of a log, whatever its name; of several parts, of all."""
    with open_log(log, allow_empty=True) as reader:
        digests = [_file_digest(path) for path in reader.paths]
    return digests[0] if len(digests) == 1 else _digest_of({"parts": digests})


def _is_kept(path: Path, made_of: str) -> bool:
    """Whether a file is there, and was made of the same."""
    if not path.is_file():
        return False
    same = TrainingMap.read_made_of(path) == made_of
    if not same:
        _log.warning("training_map_made_again", path=str(path), reason="it was made of other weights, rooms or logs")
    return same


def _map_log(log: Path, path: Path, weights: Path | None, made_of: str, stopped: Callable[[], object]) -> str:
    """Map a log and write its file; or why it teaches nothing."""
    with open_log(log) as reader:
        labels = reader.info.label_set
        if labels is None:
            return "it has no labels"
        if not reader.info.scale_known:
            return "its lengths are not metres"
        voxel_map = _map_frames(_until(reader, stopped), seen := [], weights)
    if stopped():
        return "it was stopped"
    if not seen:
        return "no labelled frame has depth"
    try:
        found = training_map(voxel_map, seen, labels)
    except MapError as error:
        return str(error)
    if not len(found.row):
        return "no label of a class that the weights know reaches the surface of its map"
    replace(found, made_of=made_of).save(path)
    return ""


def _until(frames: Iterable[PosedFrame], stopped: Callable[[], object]) -> Iterator[PosedFrame]:
    for frame in frames:
        if stopped():
            return
        yield frame


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

    Raises MapError: up cannot be found.

    Args:
        voxel_map: In the frames' world, of at least one block.
        frames: With labels, ids of ``labels``; where one has depth, hits that it contradicts do not count.
        labels: Their classes; taken over by name.
        up: (3,) in the world; None = away from the floor.
        instances: (H, W) of each frame, the same number where the same object is, 0 = none; None = not known.
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
