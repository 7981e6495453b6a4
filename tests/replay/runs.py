"""Runs to compare: walls that analytic depth is fused to, and sessions over frames of a room."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.config import MapperConfig
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.artifacts import finish_session
from semantic_mapper.replay.compare import Run
from semantic_mapper.replay.session import MapSession
from semantic_mapper.types import PosedFrame
from tests.mapping import rendered_views as views
from tests.small import tiny_config

VOXEL_M = 0.02


def wall(
    z: float = 1.0,
    channel: int = 0,
    other: int | None = None,
    p: float = 0.8,
    labels: LabelSet = views.LABELS,
    cut: int = 0,
    frames: int = 1,
    **config: float,
) -> VoxelMap:
    """A wall at depth ``z``; ``other`` is the channel of its right half, its ``cut`` right columns are missing."""
    voxel_map = views.small_map(labels, **{"voxel_size_m": VOXEL_M, **config})
    frame = views.frame(rgb=128)
    depth = np.full((frame.intrinsics.height, frame.intrinsics.width), z, np.float32)
    depth[:, frame.intrinsics.width - cut :] = 0
    votes = views.sure(channel, p, labels)
    if other is not None:
        votes[:, frame.intrinsics.width // 2 :] = views.sure(other, p, labels)[:, frame.intrinsics.width // 2 :]
    for _ in range(frames):
        voxel_map.integrate(frame, depth, votes)
    return voxel_map


def alone(voxel_map: VoxelMap, name: str = "map.npz") -> Run:
    return Run(name, voxel_map, None)


def replayed(
    weights: Path, frames: Sequence[PosedFrame], out: Path, config: MapperConfig | None = None
) -> tuple[Run, dict[str, Any]]:
    """A session over frames, and its summary; its folder is whole."""
    session = MapSession(Mapper.load(weights, config or tiny_config()), stream_labels=ROOMS, source="test")
    for frame in frames:
        session.process(frame)
    summary = finish_session(session, out)
    return Run(str(out), session.pipeline.voxel_map, summary), summary
