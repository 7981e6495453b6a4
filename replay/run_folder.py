"""What a replay, or a mapper node, has left in its folder: the summary and the map, read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.summary import SUMMARY_FILE, read_summary

MAP_FILE = "map.npz"


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run of a log.

    Args:
        name: For people.
        voxel_map: Its map.
        summary: Its ``summary.json``; None where only the map is known.
    """

    name: str
    voxel_map: VoxelMap
    summary: Mapping[str, Any] | None


def read_run(path: Path) -> Run:
    """Read the folder of a run, or a saved map alone.

    Raises:
        ConfigError: a folder with a damaged summary.
        MapError: no map there, or a damaged one.
    """
    if not path.is_dir():
        return Run(str(path), VoxelMap.load(path), None)
    voxel_map = VoxelMap.load(path / MAP_FILE)
    summary = (
        read_summary(path) if (path / SUMMARY_FILE).exists() else None
    )  # a mapper saves its map before its summary
    return Run(str(path), voxel_map, summary)
