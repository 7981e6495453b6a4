"""Stores with made-up results."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from semantic_mapper.nodes.fleet.results import ClassRow, EventRow, Findings, ResultFile, SegmentRow, TaskResult
from semantic_mapper.nodes.fleet.store import Store

NAMES = ("wall", "floor", "chair", "lamp")
FINISHED_NS = 1_790_000_000_000_000_000
VERSION = "0.1.0+aaaaaaa"


def segments_of(seed: int, loss: float = 0.0, noise: float = 0.0, noise_seed: int = 0) -> tuple[SegmentRow, ...]:
    """Twelve stretches of a log, most pixels right; ``loss`` is the fraction of right pixels that become wrong.

    ``seed`` gives truth and errors, the same in each version; ``noise`` is the spread of the fraction by which a
    stretch of this version is worse or better.
    """
    rng, own = np.random.default_rng(seed), np.random.default_rng([seed, noise_seed])
    rows = []
    count = len(NAMES)
    for number in range(12):
        truth = np.array([900, 700, 250, 60]) * rng.uniform(0.3, 1.7, count)
        right = rng.uniform(0.6, 0.9, count)
        worse = np.clip(loss + noise * own.standard_normal(count), -0.1, 0.9)
        hits = truth * np.clip(right * (1 - worse), 0.0, 1.0)
        counts = np.zeros((count, count + 1), np.int64)
        counts += np.round(((truth - hits) / count)[:, None]).astype(np.int64)
        np.fill_diagonal(counts, np.round(hits).astype(np.int64))
        rows.append(SegmentRow("replay", 10 * number, 10, NAMES, tuple(int(c) for c in counts.ravel())))
    return tuple(rows)


def miou_of(segments: Sequence[SegmentRow]) -> tuple[float, list[float]]:
    total = np.sum([np.reshape(s.counts, (len(s.names), -1)) for s in segments], axis=0)
    hits = np.diagonal(total)
    iou = hits / (total.sum(axis=1) + total[:, :-1].sum(axis=0) - hits)
    return float(iou.mean()), [float(v) for v in iou]


def made_up(log: int, *, loss: float = 0.0, noise: float = 0.0, noise_seed: int = 0, **changes: Any) -> TaskResult:
    """Result of log number ``log``."""
    segments = segments_of(log, loss, noise, noise_seed)
    miou, iou = miou_of(segments)
    rng = np.random.default_rng([log, noise_seed])
    findings = Findings(
        metrics={"miou": miou, "map_miou": miou - 0.03, "frames_fused": 120.0, "ate_m": 0.02 + 0.001 * (log % 5)},
        costs={"step_ms_p50": float(30 + 3 * rng.random()), "peak_mb": 900.0},
        classes=tuple(ClassRow("replay", name, value) for name, value in zip(NAMES, iou, strict=True)),
        events=(EventRow("refused", f"frame {log}: no pose", 7, 7_000),) if log % 3 == 0 else (),
        segments=segments,
    )
    values: dict[str, Any] = {
        "operation": "replay",
        "log": f"/logs/{log:04d}.mcap",
        "log_digest": hashlib.sha256(f"log {log}".encode()).hexdigest(),
        "log_bytes": 1000 + log,
        "tags": {"robot": f"r{log % 3}", "site": "north" if log % 2 else "south"},
        "weights": "small",
        "weights_digest": "w" * 64,
        "settings": {},
        "version": VERSION,
        "code": "c" * 64,
        "findings": findings,
        "files": {},
        "attempts": 1,
        "seconds": 40.0 + log % 7,
        "node": "host-1",
        "finished_ns": FINISHED_NS + log * 1_000_000_000,
    } | changes
    decides = [values[n] for n in ("operation", "log_digest", "weights_digest", "settings", "code")]
    key = hashlib.sha256(repr(decides).encode()).hexdigest()[:40]
    return TaskResult(key=key, folder=f"results/{key}/attempt-1", **values)


def store_of(url: Path | str, results: Sequence[TaskResult]) -> Store:
    store = Store(str(url), create=True)
    for result in results:
        assert store.commit(result)
    return store


def with_files(store: Store, result: TaskResult) -> TaskResult:
    """The result with a page and a picture in the store, not committed yet."""
    rng = np.random.default_rng(int(result.log_digest[:8], 16))
    small = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    png = cv2.imencode(".png", cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC))[1].tobytes()
    page = b"<!DOCTYPE html><html></html>"
    store.write(f"{result.folder}/overview.png", png)
    store.write(f"{result.folder}/report.html", page)
    findings = msgspec.structs.replace(result.findings, thumbnail="overview.png", report="report.html")
    contents = {"overview.png": png, "report.html": page}
    files = {n: ResultFile(len(data), hashlib.sha256(data).hexdigest()) for n, data in contents.items()}
    return msgspec.structs.replace(result, findings=findings, files=files)
