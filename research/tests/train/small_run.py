"""A training run that takes seconds: tiny rooms, a tiny field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open

from research.train.train_config import TrainConfig
from semantic_mapper.config import convert_config, to_plain
from tests.small import SMALL_MODEL

TIMES = {"seconds", "waited_s"}
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


def contents(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, object]]:
    """Tensors and metadata of a state, but for what a clock says."""
    with safe_open(path, framework="pt") as stored:
        tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
        metadata = dict(stored.metadata())
    del metadata["elapsed_s"], metadata["images_s"]
    history = json.loads(metadata.pop("history"))
    lines = [{k: v for k, v in line.items() if k not in TIMES} for line in history]
    return tensors, {**metadata, "history": lines}
