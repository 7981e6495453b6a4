import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from resource import RLIMIT_FSIZE, getrlimit, setrlimit

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.block_store import (
    BLOCK_VOXELS,
    BlockStore,
    BlockValues,
    pack_blocks,
    unpack_blocks,
)

CLASSES = 3


def some_blocks(count: int, seed: int = 0, evidence: str = "float32") -> BlockValues:
    """Blocks as a map has them: what holds no measurement (or no vote) is zero."""
    rng = np.random.default_rng(seed)
    measured = rng.random((count, BLOCK_VOXELS)) < 0.6
    voted = measured & (rng.random((count, BLOCK_VOXELS)) < 0.3)

    def of(mask: np.ndarray, *tail: int) -> np.ndarray:
        values = rng.standard_normal((*mask.shape, *tail)).astype(np.float32)
        return np.where(mask.reshape(*mask.shape, *(1 for _ in tail)), values, np.float32(0))

    weight, votes = np.abs(of(measured)) + measured, np.abs(of(voted)) + voted
    said = (of(voted, CLASSES) * (1 if evidence == "float32" else 1000)).astype(evidence)
    return BlockValues(of(measured), weight.astype(np.float32), of(measured, 3), said, votes.astype(np.float32))


@pytest.mark.parametrize("evidence", ["float32", "int16"])
def test_blocks_come_back_equal_to_the_bit_in_any_order(evidence: str):
    store, blocks = BlockStore(CLASSES, evidence), some_blocks(1200, evidence=evidence)
    keys = np.arange(1200, dtype=np.int64) * 7 + 3000
    store.put(keys, np.arange(1200), blocks)
    order = np.random.default_rng(1).permutation(1200)
    back = store.get(keys[order])
    for name in BlockValues._fields:
        assert getattr(back, name).tobytes() == getattr(blocks, name)[order].tobytes(), name
    assert len(store) == 1200
    np.testing.assert_array_equal(store.versions_of(keys), np.arange(1200))
    np.testing.assert_array_equal(store.holds(np.array([keys[0], 1])), [True, False])


def test_a_block_put_away_again_replaces_the_old_one_and_a_dropped_one_is_gone():
    store = BlockStore(CLASSES)
    key = np.array([42], np.int64)
    store.put(key, np.array([1]), some_blocks(1, 1))
    newer = some_blocks(1, 2)
    store.put(key, np.array([2]), newer)
    assert store.get(key).tsdf.tobytes() == newer.tsdf.tobytes()
    assert [store.keys.tolist(), store.versions.tolist()] == [[42], [2]]
    store.drop(key)
    assert len(store) == 0
    with pytest.raises(MapError, match="missing"):
        store.get(key)


def test_an_empty_block_survives():
    store = BlockStore(CLASSES)
    nothing = BlockValues(*(np.zeros_like(v) for v in some_blocks(1)))
    store.put(np.array([1], np.int64), np.array([0]), nothing)
    assert not any(v.any() for v in store.get(np.array([1], np.int64)))


@pytest.mark.parametrize("position", [0, 70, 500, -1])
def test_a_flipped_bit_on_disk_is_found(position: int, monkeypatch: pytest.MonkeyPatch):
    opened: list[sqlite3.Connection] = []
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *a, **k: opened.append(connect(*a, **k)) or opened[-1])
    store = BlockStore(CLASSES)
    store.put(np.array([1, 2], np.int64), np.array([0, 0]), some_blocks(2))
    (voxels,) = opened[0].execute("SELECT voxels FROM blocks WHERE key = 2").fetchone()
    bad = bytearray(voxels)
    bad[position] ^= 4
    opened[0].execute("UPDATE blocks SET voxels = ? WHERE key = 2", (bytes(bad),))
    store.get(np.array([1], np.int64))
    with pytest.raises(MapError, match="block 2 on disk is damaged"):
        store.get(np.array([1, 2], np.int64))


def test_a_closed_store_says_so():
    store = BlockStore(CLASSES)
    store.close()
    with pytest.raises(MapError, match="cannot be put on disk"):
        store.put(np.array([1], np.int64), np.array([0]), some_blocks(1))
    with pytest.raises(MapError, match="cannot be read"):
        store.get(np.array([1], np.int64))


@contextmanager
def files_at_most(size: int) -> Iterator[None]:
    """Writing beyond this many bytes of any file fails meanwhile, as on a disk that is full."""
    before = getrlimit(RLIMIT_FSIZE)
    setrlimit(RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        setrlimit(RLIMIT_FSIZE, before)


def expect(store: BlockStore, held: dict[int, int]) -> None:
    """The store holds these keys, each with the block of ``some_blocks(1, seed)``."""
    assert len(store) == len(held) and store.holds(np.array(list(held), np.int64)).all()
    back = store.get(np.array(list(held), np.int64))
    for n, seed in enumerate(held.values()):
        for name, mine in some_blocks(1, seed)._asdict().items():
            assert getattr(back, name)[n].tobytes() == mine.tobytes(), (n, name)


def put(store: BlockStore, held: dict[int, int], keys: range, seed: int) -> None:
    blocks = [some_blocks(1, seed + key) for key in keys]
    joined = BlockValues(*(np.concatenate([getattr(b, name) for b in blocks]) for name in BlockValues._fields))
    store.put(np.array(keys, np.int64), np.full(len(keys), seed), joined)
    held.update((key, seed + key) for key in keys)


def test_a_full_disk_takes_nothing_from_the_store_and_room_mends_it():
    """Some 10 KB a block, where SQLite keeps 4 MB in memory: the disk is full in the midst of a transaction."""
    store, held = BlockStore(CLASSES), dict[int, int]()
    put(store, held, range(600), 1)
    with files_at_most(store.file_bytes + 100_000):
        for keys in (range(600, 1600), range(300, 1300), range(2000, 2900)):
            with pytest.raises(MapError, match=r"\d+ blocks cannot be put on disk: disk I/O error; make room"):
                put(store, dict(held), keys, 5)
        expect(store, held)
        store.drop(np.arange(100))
        put(store, held, range(5000, 5050), 7)  # there is room again
        for key in range(100):
            del held[key]
        expect(store, held)
    put(store, held, range(400, 1500), 9)
    expect(store, held)
    assert store._database.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_a_database_that_may_not_grow_takes_nothing_from_the_store():
    store, held = BlockStore(CLASSES), dict[int, int]()
    put(store, held, range(50), 1)
    (pages,) = store._database.execute("PRAGMA page_count").fetchone()
    store._database.execute(f"PRAGMA max_page_count = {pages + 5}")
    with pytest.raises(MapError, match="60 blocks cannot be put on disk: database or disk is full"):
        put(store, dict(held), range(20, 80), 5)
    expect(store, held)
    store._database.execute(f"PRAGMA max_page_count = {1 << 30}")
    put(store, held, range(20, 80), 5)
    expect(store, held)


def test_a_drop_that_fails_forgets_nothing():
    store, held = BlockStore(CLASSES), dict[int, int]()
    put(store, held, range(40), 1)
    store._database.execute("PRAGMA query_only = ON")
    with pytest.raises(MapError, match="10 blocks cannot be taken off the disk: attempt to write a readonly"):
        store.drop(np.arange(10))
    store._database.execute("PRAGMA query_only = OFF")
    expect(store, held)


@pytest.mark.parametrize(("evidence", "classes"), [("float32", 3), ("int16", 3), ("int16", 4)])
def test_packed_blocks_are_masks_and_the_voxels_that_they_name(evidence: str, classes: int):
    blocks = some_blocks(6, 4, evidence)
    blocks = blocks._replace(evidence=np.ascontiguousarray(blocks.evidence[..., np.arange(classes) % CLASSES]))
    blocks.weight[2], blocks.votes[2] = 0, 0
    rows = np.array([4, 2, 0], np.int32)
    packed = pack_blocks(blocks, rows)
    assert packed.ends[0] == 0 and len(packed.blobs()) == 3
    for row, blob in zip(rows, packed.blobs(), strict=True):
        measured, voted = blocks.weight[row] > 0, blocks.votes[row] > 0
        said = blocks.evidence[row][voted]
        padded = np.zeros((len(said), -(-classes * said.itemsize // 4) * 4 // said.itemsize), said.dtype)
        padded[:, :classes] = said
        parts = (blocks.tsdf[row][measured], blocks.weight[row][measured], blocks.color[row][measured], padded)
        expected = [np.packbits(measured), np.packbits(voted), *parts, blocks.votes[row][voted]]
        assert bytes(blob) == b"".join(part.tobytes() for part in expected)


def test_bytes_that_are_no_packed_block_are_refused():
    blocks = some_blocks(1, 5)
    blob = bytes(pack_blocks(blocks, np.zeros(1, np.int32)).blobs()[0])
    empty = BlockValues(*(np.zeros_like(values) for values in blocks))
    for wrong in (b"", blob[:100], blob[:-4], blob[:-1], blob + bytes(4), b"\xff" * len(blob)):
        with pytest.raises(MapError, match="packed block"):
            unpack_blocks([wrong], empty, np.zeros(1, np.int64))
    assert not any(values.any() for values in empty)
    unpack_blocks([memoryview(blob)], empty, np.zeros(1, np.int64))
    assert empty.tsdf.tobytes() == blocks.tsdf.tobytes()
