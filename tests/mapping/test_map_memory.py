"""Saving and loading take the memory of the limit and of a few chunks, not that of the map."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.mapping.files.map_file import CHUNK_BLOCKS, BlockPart, MapManifest, describe_map, write_map
from semantic_mapper.mapping.storage.block_store import BLOCK_VOXELS, BlockValues
from tests.mapping.files.crash_child import measure_memory, start_child

CLASSES = 20
LABELS = make_label_set("many", tuple(f"class {i}" for i in range(CLASSES)), ids=tuple(range(1, CLASSES + 1)))
BLOCK_BYTES = 4 * BLOCK_VOXELS * (CLASSES + 6)
CHUNKS = 20
MAP_BYTES = CHUNKS * CHUNK_BLOCKS * BLOCK_BYTES
MEMORY_MB = 25


def a_part(x: int) -> BlockPart:
    """Blocks of one plane of blocks, with few voxels that hold something."""
    rng = np.random.default_rng(x)
    y, z = np.divmod(np.arange(CHUNK_BLOCKS, dtype=np.int32), 16)
    keys = np.stack((np.full_like(y, x), y, z), axis=1)
    held = rng.random((CHUNK_BLOCKS, BLOCK_VOXELS)) < 0.03
    channels = (1, 1, 3, CLASSES, 1)
    values = [(held[..., None] * (1 + rng.random(n))).astype(np.float32) for n in channels]
    return keys, BlockValues(*(value[..., 0] if value.shape[2] == 1 else value for value in values))


def parts(count: int) -> Iterator[BlockPart]:
    return (a_part(x) for x in range(count))


def manifest(labels: LabelSet = LABELS) -> MapManifest:
    return MapManifest(config=VoxelMapConfig(), label_set=labels, frames=7, last_stamp_ns=5)


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of 270 MB; ``small.npz`` beside it is of 1 chunk."""
    path = tmp_path_factory.mktemp("building") / "map.npz"
    write_map(path, manifest(), parts(CHUNKS))
    write_map(path.with_name("small.npz"), manifest(), parts(1))
    return path


@pytest.mark.parametrize("memory_mb", [MEMORY_MB, 0])
def test_memory_is_that_of_the_limit(building: Path, tmp_path: Path, memory_mb: int) -> None:
    out = tmp_path / "out.npz"
    process, link = start_child(measure_memory, building, out, memory_mb)
    grown, stored = link.recv()
    process.join()
    if memory_mb == 0:
        assert stored == 0 and grown > 0.9 * MAP_BYTES  # what is measured is what it costs without a limit
        assert out.read_bytes() == building.read_bytes()
    else:
        assert stored > (CHUNKS - 3) * CHUNK_BLOCKS
        assert grown < 1e6 * MEMORY_MB + 4 * CHUNK_BLOCKS * BLOCK_BYTES < 0.35 * MAP_BYTES
        found = {path: [c.sha256 for c in describe_map(path).chunks] for path in (out, building)}
        assert found[out] == found[building] and len(found[out]) == CHUNKS
