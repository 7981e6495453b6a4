"""A training run that takes seconds: tiny rooms, a tiny field."""

from __future__ import annotations

from typing import Any

from semantic_mapper.config import convert_config, to_plain
from semantic_mapper.training.train_config import TrainConfig
from tests.small import SMALL_MODEL

POOL = {"width": 48, "views": 5, "rooms": 3, "rooms_at_start": 2, "draws_per_room": 2}


def small_run(**changes: Any) -> TrainConfig:
    """Eight steps by default; ``changes`` replace whole sections."""
    base: dict[str, Any] = {
        "field": to_plain(SMALL_MODEL),
        "seconds": 0,
        "steps": 8,
        "log_steps": 2,
        "device": "cpu",
        "pool": POOL,
        "step": {"rays": 64, "views_max": 4, "samples_without_depth": 8},
        "validation": {"times": 2, "rooms": 1, "queries": 1, "rays": 64, "views": 3},
    }
    return convert_config({**base, **changes}, TrainConfig, "test config")
