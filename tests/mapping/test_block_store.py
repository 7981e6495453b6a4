import sqlite3

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.block_store import BLOCK_VOXELS, BlockStore, BlockValues

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
    np.testing.assert_array_equal(store.versions.find(keys), np.arange(1200))
    np.testing.assert_array_equal(store.holds(np.array([keys[0], 1])), [True, False])


def test_a_block_put_away_again_replaces_the_old_one_and_a_dropped_one_is_gone():
    store = BlockStore(CLASSES)
    key = np.array([42], np.int64)
    store.put(key, np.array([1]), some_blocks(1, 1))
    newer = some_blocks(1, 2)
    store.put(key, np.array([2]), newer)
    assert store.get(key).tsdf.tobytes() == newer.tsdf.tobytes()
    assert [a.tolist() for a in store.versions.items()] == [[42], [2]]
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
