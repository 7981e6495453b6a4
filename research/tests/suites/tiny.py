"""The smallest benchmark that goes all the way: one room or two, 48x36 pixels, few frames, untrained weights."""

from __future__ import annotations

from functools import cache

from research.scenes import VALIDATION_SEEDS
from research.suites.config import SuiteConfig
from research.suites.protocols import Entry
from research.suites.rooms import BenchmarkRoom, make_benchmark_room
from semantic_mapper.config import convert_config
from tests.small import tiny_field

ROOM = VALIDATION_SEEDS[0]


def tiny_suite(**changes: object) -> SuiteConfig:
    sampling = {"guided": 4, "free_space": 0}
    base = {
        "split": "val",
        "rooms": 1,
        "views": 3,
        "tier": {"width": 48, "guided": sampling, "blind": {"guided": 6, "free_space": 0}},
        "sequence": {"frames": 14, "query_pairs": 1, "pair_gap": 2},
        "scene": {"keyframes": 3, "guard": 1, "seconds": 0, "steps": 2, "shares": (0.5, 1.0)},
        "map_frames": 3,
    }
    return convert_config({**base, **changes}, SuiteConfig, "test suite")


@cache
def tiny_room(depth: str = "on") -> BenchmarkRoom:
    return make_benchmark_room(ROOM, tiny_suite(depth=depth))


def tiny_contestant(seed: int = 0) -> Entry:
    return Entry(f"tiny{seed}", f"digest{seed}", tiny_field(seed=seed), file=f"tiny{seed}.safetensors")
