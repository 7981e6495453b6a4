"""Processes that save maps are killed at any moment, and what they leave is a whole map."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, BlockValues
from semantic_mapper.mapping.map_file import CHUNK_BLOCKS, BlockPart, MapManifest, describe_map, write_map
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.crash_child import map_and_save, measure_memory, save_where_files_stay_small, start_child
from tests.mapping.rendered_views import small_map
from tests.mapping.test_paging import walk
from tests.mapping.test_voxel_map import fuse_sphere, same

SAVERS_KILLED = 47
MAPPERS_KILLED = 3


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """A map, and what two more frames make of it, and two more."""
    voxel_map = small_map(voxel_size_m=0.03)
    paths = [tmp_path / f"frames-{count}.npz" for count in (3, 5, 7)]
    for frames, path in zip((3, 2, 2), paths, strict=True):
        fuse_sphere(voxel_map, frames)
        voxel_map.save(path)
    return paths


@pytest.mark.slow
def test_a_killed_mapper_with_blocks_on_disk_leaves_the_map_of_some_frame(tmp_path: Path) -> None:
    reference = small_map(voxel_size_m=0.01)
    rng = random.Random(1)
    left: list[tuple[int, Path]] = []
    for n in range(MAPPERS_KILLED):
        out = tmp_path / f"map{n}.npz"
        process, link = start_child(map_and_save, out)
        while not link.recv():  # until a map with blocks on disk was saved
            pass
        time.sleep(rng.uniform(0, 0.7))
        process.kill()
        process.join()
        left.append((describe_map(out).frames, out))
    for frames, out in sorted(left):
        walk(reference, frames - reference.frames, first=reference.frames)
        assert same(VoxelMap.load(out).block_state(), reference.block_state()), f"{out} after {frames} frames"


def test_a_full_disk_is_told_and_the_old_map_stays(maps: list[Path], tmp_path: Path) -> None:
    old, new, other = maps
    before = old.read_bytes()
    process, link = start_child(save_where_files_stay_small, new, old, len(before) // 2)
    assert "cannot write the map: File too large" in link.recv()
    process.join()
    assert old.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in (old, new, other))


CLASSES = 20
LABELS = make_label_set("many", tuple(f"class {i}" for i in range(CLASSES)), ids=tuple(range(1, CLASSES + 1)))
BLOCK_BYTES = BLOCK_VOXELS * (2 * CLASSES + 4 * 6)
CHUNKS = 20
MAP_BYTES = CHUNKS * CHUNK_BLOCKS * BLOCK_BYTES
MEMORY_MB = 25


def a_part(x: int) -> BlockPart:
    """Blocks of one plane of blocks, with few voxels that hold something."""
    rng = np.random.default_rng(x)
    y, z = np.divmod(np.arange(CHUNK_BLOCKS, dtype=np.int32), 16)
    keys = np.stack((np.full_like(y, x), y, z), axis=1)
    held = rng.random((CHUNK_BLOCKS, BLOCK_VOXELS)) < 0.03
    channels = ((1, "f4"), (1, "f4"), (3, "f4"), (CLASSES, "u2"), (1, "f4"))
    values = [(held[..., None] * (1 + 9 * rng.random(n))).astype(dtype) for n, dtype in channels]
    return keys, BlockValues(*(value[..., 0] if value.shape[2] == 1 else value for value in values))


def parts(count: int) -> Iterator[BlockPart]:
    return (a_part(x) for x in range(count))


def manifest(labels: LabelSet = LABELS) -> MapManifest:
    return MapManifest(config=VoxelMapConfig(), label_set=labels, frames=7, last_stamp_ns=5)


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of 170 MB; ``small.npz`` beside it is of 1 chunk."""
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
