"""The table of blocks on disk, against a dict."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.key_table import ABSENT, KeyTable

# Few keys, so that they are put, put again and removed often; neighbours, as blocks of a map are.
KEYS = pack_keys(np.stack(np.meshgrid(*[np.arange(-3, 3)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.int32))
some_keys = st.lists(st.integers(0, len(KEYS) - 1), max_size=60, unique=True)


@given(st.lists(st.tuples(st.booleans(), some_keys), max_size=20))
def test_it_does_what_a_dict_does(steps: list[tuple[bool, list[int]]]) -> None:
    table, truth = KeyTable(), dict[int, int]()
    for number, (putting, chosen) in enumerate(steps):
        keys = KEYS[np.array(chosen, int)]
        if putting:
            table.put(keys, np.full(len(keys), number))
            truth.update(dict.fromkeys(keys.tolist(), number))
        else:
            table.remove(keys)
            for key in keys.tolist():
                truth.pop(key, None)
        assert len(table) == len(truth)
        np.testing.assert_array_equal(table.find(KEYS), [truth.get(key, ABSENT) for key in KEYS.tolist()])
    keys, versions = table.items()
    assert dict(zip(keys.tolist(), versions.tolist(), strict=True)) == truth


def test_many_keys_come_and_go_and_every_one_can_be_given_a_version() -> None:
    rng = np.random.default_rng(0)
    keys = pack_keys(np.unique(rng.integers(-40, 40, (20_000, 3)), axis=0).astype(np.int32))
    table = KeyTable()
    for part in np.array_split(rng.permutation(keys), 50):
        table.put(part, part % 1000)
    gone = rng.permutation(keys)[: len(keys) // 2]
    for part in np.array_split(gone, 50):
        table.remove(part)
    there = ~np.isin(keys, gone)
    np.testing.assert_array_equal(table.find(keys), np.where(there, keys % 1000, ABSENT))
    assert len(table) == there.sum()
    assert len(table.items()[0]) == len(table)
