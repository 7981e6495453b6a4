"""Whatever the bytes: an error of ours at most."""

from __future__ import annotations

import random
from contextlib import suppress

import pytest

from research.experiments.fuzz_targets import TARGETS, flip
from semantic_mapper.errors import MapError, SemanticMapperError


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_raise_nothing_but_our_errors(name: str) -> None:
    """A second of what ``research/experiments/fuzz.py`` does, without its guidance."""
    target, rng = TARGETS[name], random.Random(7)
    seeds = target.seeds()
    for seed in seeds[: 1 if name == "log" else None]:
        with suppress(MapError):  # the answer that is an error
            target.read(seed)
    refused = 0
    for _ in range(60 if name == "log" else 1500):
        data = rng.choice(seeds)
        for _ in range(rng.randint(1, 3)):
            data = target.mutate(data, rng, lambda part: flip(part, rng))
        try:
            target.read(data)
        except SemanticMapperError:
            refused += 1
    assert refused
