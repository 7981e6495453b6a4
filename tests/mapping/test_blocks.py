from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from resource import RLIMIT_FSIZE, getrlimit, setrlimit

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.blocks import (
    BLOCK_VOXELS,
    KEY_LIMIT,
    BlockStore,
    BlockValues,
    ScratchFile,
    empty_blocks,
    find_blocks,
    insert_blocks,
    make_block_index,
    pack_blocks,
    pack_keys,
    unpack_blocks,
    unpack_keys,
)

CLASSES = 3


def some_blocks(count: int, seed: int = 0) -> BlockValues:
    """Blocks as a map has them: what holds no measurement (or no vote) is zero."""
    rng = np.random.default_rng(seed)
    measured = rng.random((count, BLOCK_VOXELS)) < 0.6
    voted = measured & (rng.random((count, BLOCK_VOXELS)) < 0.3)

    def of(mask: np.ndarray, *tail: int) -> np.ndarray:
        values = rng.standard_normal((*mask.shape, *tail)).astype(np.float32)
        return np.where(mask.reshape(*mask.shape, *(1 for _ in tail)), values, np.float32(0))

    weight, votes = np.abs(of(measured)) + measured, np.abs(of(voted)) + voted
    said = (4096 * np.abs(of(voted, CLASSES))).astype(np.uint16)
    return BlockValues(of(measured), weight.astype(np.float32), of(measured, 3), said, votes.astype(np.float32))


def pack_all(blocks: BlockValues):
    return pack_blocks(blocks, np.arange(len(blocks.tsdf), dtype=np.int32))


def test_blocks_come_back_equal_to_the_bit_in_any_order_and_dropped_ones_are_gone() -> None:
    store, blocks, rng = BlockStore(), some_blocks(1200), np.random.default_rng(1)
    keys, order = rng.permutation(1200) * 7 + 3000, rng.permutation(1200)
    store.put(keys, pack_all(blocks), np.arange(1200), keys % 2 == 0)
    back = empty_blocks(1200, CLASSES)
    store.read_into(back, np.arange(1200), keys[order])
    for name in BlockValues._fields:
        assert getattr(back, name).tobytes() == getattr(blocks, name)[order].tobytes(), name
    rows, there = store.find(np.append(keys, 1))
    assert len(store) == 1200 and there[:-1].all() and not there[-1]
    np.testing.assert_array_equal(store.versions[rows[:-1]], np.arange(1200))
    np.testing.assert_array_equal(store.surface, store.keys % 2 == 0)
    store.drop(keys[:1000])
    assert sorted(store.keys) == sorted(keys[1000:])
    with pytest.raises(MapError, match="missing"):
        store.read_into(empty_blocks(1, CLASSES), np.zeros(1, np.int64), keys[:1])


def test_bytes_that_are_no_packed_block_are_refused() -> None:
    blob = bytes(pack_all(some_blocks(1, 5)).blobs()[0])
    empty = empty_blocks(1, CLASSES)
    for wrong in (b"", blob[:100], blob[:-4], blob[:-1], blob + bytes(4), b"\xff" * len(blob)):
        with pytest.raises(MapError, match="packed block"):
            unpack_blocks([wrong], empty, np.zeros(1, np.int64))
    assert not any(values.any() for values in empty)


@contextmanager
def files_at_most(size: int) -> Iterator[None]:
    """Writing beyond this many bytes of any file fails meanwhile, as on a disk that is full."""
    before = getrlimit(RLIMIT_FSIZE)
    setrlimit(RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        setrlimit(RLIMIT_FSIZE, before)


def blobs(keys: range, seed: int) -> list[bytes]:
    return [bytes([seed, key % 251]) * 5000 for key in keys]


def test_a_full_disk_takes_nothing_from_a_scratch_file_and_it_works_again_once_there_is_room() -> None:
    """SQLite keeps 4 MB in memory: the disk is full in the midst of a transaction."""
    scratch = ScratchFile("frames", "keep fewer")
    scratch.put(range(600), blobs(range(600), 1))
    with files_at_most(scratch.file_bytes + 100_000):
        for keys in (range(600, 1600), range(300, 1300)):
            with pytest.raises(MapError, match=r"1000 frames cannot be put on disk: disk I/O error; .*keep fewer"):
                scratch.put(keys, blobs(keys, 5))
        assert scratch.get(range(600)) == blobs(range(600), 1)
        scratch.drop(range(100))
        scratch.put(range(5000, 5050), blobs(range(5050 - 50, 5050), 7))  # there is room again
        with pytest.raises(MapError, match="number 99 is missing"):
            scratch.get([99])
    scratch.put(range(400, 1500), blobs(range(400, 1500), 9))
    assert scratch.get([5049, 1499, 399]) == [
        *blobs(range(5049, 5050), 7),
        *blobs(range(1499, 1500), 9),
        *blobs(range(399, 400), 1),
    ]
    scratch.close()
    with pytest.raises(MapError, match="cannot be read"):
        scratch.get([399])


def test_a_flipped_bit_on_disk_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = ScratchFile("blocks", "")
    scratch.put([3], [b"abcdef"])
    scratch._database.execute("UPDATE blobs SET blob = ?", (b"abcdeg",))
    with pytest.raises(MapError, match="number 3 is missing or damaged"):
        scratch.get([3])


coordinate = st.integers(-KEY_LIMIT, KEY_LIMIT - 1)
triples = st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=50, unique=True)


@given(triples)
def test_packing_is_lossless_and_sorts_like_the_triples(keys: list[tuple[int, int, int]]) -> None:
    array = np.array(keys, np.int32)
    packed = pack_keys(array)
    assert (unpack_keys(packed) == array).all()
    assert [tuple(k) for k in unpack_keys(np.sort(packed)).tolist()] == sorted(keys)


@given(triples)
def test_what_was_put_in_is_found_and_nothing_else(keys: list[tuple[int, int, int]]) -> None:
    array = np.array(keys, np.int32)
    half = len(keys) // 2
    values = np.arange(len(keys), dtype=np.int32)
    index = make_block_index(array[:half], values[:half])
    assert (find_blocks(index, pack_keys(array))[half:] == -1).all()
    insert_blocks(index, pack_keys(array[half:]), values[half:])
    assert (find_blocks(index, pack_keys(array)) == values).all()
