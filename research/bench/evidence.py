"""Measure what compact class evidence costs: memory a block, and maps of validation rooms against float32."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec.structs import replace as with_fields

from research.bench.virtual import Judge, Tally, map_frames, validation_frames
from research.scenes import VALIDATION_SEEDS
from semantic_mapper.config import MapperConfig, with_quality
from semantic_mapper.mapping.fusion.evidence import EVIDENCE_DTYPES


def bench_evidence(weights: Path | None, config: MapperConfig, rooms: int = 4) -> dict[str, Any]:
    """Map the same frames of validation rooms with each ``voxel_map.evidence``.

    Returns:
        Plain data: by kind the map's mIoU and accuracy (a point without votes is wrong), ECE of the points with votes,
        and KiB a block, all rooms together.
    """
    config = with_quality(config)
    tallies: dict[str, Tally] = {}
    block_kib: dict[str, float] = {}
    for seed in VALIDATION_SEEDS[:rooms]:
        frames = validation_frames(seed)
        judge = Judge(seed, frames, tallies)
        for kind in EVIDENCE_DTYPES:
            chosen = with_fields(config, voxel_map=with_fields(config.voxel_map, evidence=kind))
            pipeline, _ = map_frames(weights, chosen, frames, 1)
            judge.add(kind, pipeline.voxel_map, 0.0)
            with pipeline.voxel_map.locked() as grid:
                block_kib[kind] = round(grid.block_bytes / 1024, 1)
    kept = ("miou", "accuracy", "ece")
    rows = {kind: {name: tally.row()[name] for name in kept} for kind, tally in tallies.items()}
    return {"rooms": rooms, "kinds": {kind: {**row, "block_kib": block_kib[kind]} for kind, row in rows.items()}}
