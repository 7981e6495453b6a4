from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.mapping.storage.block_index import (
    KEY_LIMIT,
    find_blocks,
    insert_blocks,
    make_block_index,
    pack_keys,
    unpack_keys,
)

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
