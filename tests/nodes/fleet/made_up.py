"""Stores with made-up results."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.evaluation.metrics import miou_of_sums
from semantic_mapper.nodes.fleet.store import Failure, Findings, MethodScores, Store, TaskResult

NAMES = ("wall", "floor", "chair", "lamp")
FINISHED_NS = 1_790_000_000_000_000_000
VERSION = "0.1.0+aaaaaaa"


def scores_of(seed: int, loss: float = 0.0, noise: float = 0.0, noise_seed: int = 0) -> MethodScores:
    """Twelve stretches of a log, most pixels right; ``loss`` is the fraction of right pixels that become wrong.

    ``seed`` gives truth and errors, the same in each version; ``noise`` is the spread of the fraction by which a
    stretch of this version is worse or better.
    """
    rng, own = np.random.default_rng(seed), np.random.default_rng([seed, noise_seed])
    truth = np.array([900, 700, 250, 60]) * rng.uniform(0.3, 1.7, (12, 4))
    worse = np.clip(loss + noise * own.standard_normal((12, 4)), -0.1, 0.9)
    hits = truth * np.clip(rng.uniform(0.6, 0.9, (12, 4)) * (1 - worse), 0.0, 1.0)
    sums = np.round(np.stack((hits, truth, 2 * truth - hits), axis=1)).astype(int)  # what is missed is predicted again
    total = sums.sum(axis=0)
    iou: dict[str, float | None] = {name: float(value) for name, value in zip(NAMES, total[0] / total[2], strict=True)}
    stretches = tuple(tuple(tuple(row) for row in part) for part in sums.tolist())
    return MethodScores("map", iou, NAMES, stretches, tuple(range(0, 120, 10)))


def made_up(log: int, *, loss: float = 0.0, noise: float = 0.0, noise_seed: int = 0, **changes: Any) -> TaskResult:
    """Result of log number ``log``."""
    scores = scores_of(log, loss, noise, noise_seed)
    miou = float(miou_of_sums(np.array(scores.stretches, np.float64).sum(axis=0, keepdims=True))[0])
    values: dict[str, Any] = {
        "operation": "map",
        "log": f"/logs/{log:04d}.mcap",
        "log_digest": hashlib.sha256(f"log {log}".encode()).hexdigest(),
        "tags": {"robot": f"r{log % 3}"},
        "weights": "",
        "settings": {},
        "version": VERSION,
        "findings": Findings(
            metrics={"miou": miou, "frames_fused": 100.0, "blocks": 500.0 + log, "depth_disagreement": None},
            costs={"step_ms_p50": 30.0 + log % 5},
            scores=(scores,),
            events=(("refused", "frame 7: pose jumps"),),
        ),
        "files": {},
        "seconds": 40.0 + log % 7,
        "node": "host-1",
        "finished_ns": FINISHED_NS + log * 1_000_000_000,
    } | changes
    decides = [values[n] for n in ("operation", "log_digest", "weights", "settings", "version")]
    key = hashlib.sha256(repr(decides).encode()).hexdigest()[:40]
    return TaskResult(**{"key": key, "folder": f"files/{key}/one", **values})


def failure_of(result: TaskResult, error: str = "LogError: cut off") -> Failure:
    given = {name: getattr(result, name) for name in ("operation", "log", "tags")}
    return Failure(key="f" + result.key[1:], **given, version=VERSION, error=error, finished_ns=FINISHED_NS)


def store_of(url: Path | str, results: Sequence[TaskResult] = ()) -> Store:
    store = Store(str(url), create=True)
    for result in results:
        assert store.commit(result)
    return store
