"""Stores with made-up results."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.nodes.fleet.store import Failure, Findings, MethodScores, Store, TaskResult

NAMES = ("wall", "floor", "chair", "lamp")
FINISHED_NS = 1_790_000_000_000_000_000
VERSION = "0.1.0+aaaaaaa"


def made_up(log: int, *, loss: float = 0.0, noise: float = 0.0, noise_seed: int = 0, **changes: Any) -> TaskResult:
    """Result of log number ``log``, whose IoU the log gives, the same in each version; ``noise`` is the spread by which
    this version is worse or better in addition to ``loss``."""
    own = np.random.default_rng([log, noise_seed]).standard_normal(len(NAMES))
    values_of = np.random.default_rng(log).uniform(0.5, 0.8, len(NAMES)) - loss + noise * own
    scores = MethodScores("map", dict(zip(NAMES, values_of.tolist(), strict=True)))
    miou = float(values_of.mean())
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
