"""How often `fleet compare` calls a fleet worse that is not, and how often it finds one that is, on simulated logs.

A log has 12 stretches of frames and 8 classes of uneven frequency. The result B of a log differs from A by a loss that
all logs share, by one of its own, and by noise in each stretch and class. Figures come from ``compare_stores``, as
those of the verb do.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.evaluation.bootstrap import class_sums, miou_of_counts
from semantic_mapper.nodes.fleet.compare import FleetComparison, compare_stores
from semantic_mapper.nodes.fleet.store import Findings, MethodScores, Store, TaskResult
from semantic_mapper.types import Float64

CLASSES, STRETCHES = 8, 12
NAMES = tuple(f"class {n}" for n in range(CLASSES))
NOISE = 0.03  # spread of the fraction of right pixels of a class in a stretch
FREQUENCY = np.array([0.35, 0.25, 0.15, 0.1, 0.07, 0.04, 0.03, 0.01])
_NUMBERS = count()


class SimulatedLog:
    """Truth and errors of a log, the same for all its results."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.truth = 50_000 * FREQUENCY * rng.lognormal(0, 0.6, (STRETCHES, CLASSES))
        present = np.sqrt(FREQUENCY / FREQUENCY.max())  # rare classes are not in all stretches
        self.truth *= rng.random((STRETCHES, CLASSES)) < present
        base = rng.normal(1.2, 0.6, CLASSES) + rng.normal(0, 0.4, (STRETCHES, CLASSES))
        self.right = 1 / (1 + np.exp(-base))
        self.confused = rng.dirichlet(np.full(CLASSES, 0.6), (STRETCHES, CLASSES))  # (S, truth, prediction)

    def counts(self, loss: float, noise: Float64) -> Float64:
        """(S, L, L + 1); ``loss`` is the fraction of right pixels that become wrong, to which ``noise`` (S, L) adds."""
        hits = self.truth * np.clip(self.right * (1 - loss - noise), 0, 1)
        wrong = (self.truth - hits)[:, :, None] * self.confused
        counts = np.concatenate((wrong, np.zeros((STRETCHES, CLASSES, 1))), axis=2)
        diagonal = np.arange(CLASSES)
        counts[:, diagonal, -1] = counts[:, diagonal, diagonal]
        counts[:, diagonal, diagonal] = hits
        return np.round(counts)


def result(number: int, counts: Float64) -> TaskResult:
    """A result that has stretches alone."""
    stretches: Any = tuple(tuple(map(tuple, part)) for part in class_sums(counts).astype(int).tolist())
    scores = MethodScores("replay", {}, NAMES, stretches, tuple(range(STRETCHES)))
    miou = float(miou_of_counts(counts.sum(axis=0, keepdims=True))[0])
    name = f"{number:05d}"
    return TaskResult(
        key=name,
        operation="replay",
        log=name,
        log_digest=name,
        tags={},
        weights="",
        settings={},
        version="0",
        findings=Findings({"miou": miou}, scores=(scores,)),
        files={},
        folder=f"files/{name}/1",
        seconds=1.0,
        node="host",
        finished_ns=0,
    )


def pairs(
    rng: np.random.Generator, logs: int, loss: float, own: float, first_loss: float
) -> Iterator[tuple[TaskResult, TaskResult]]:
    """Results of a fleet: all logs lose ``loss``, each one's own is of spread ``own``, and the first loses more."""
    for number in range(logs):
        log = SimulatedLog(rng)
        mine = loss + own * rng.standard_normal() + (first_loss if number == 0 else 0.0)
        noises = NOISE * rng.standard_normal((2, STRETCHES, CLASSES)) / np.sqrt(2)
        yield result(number, log.counts(0.0, noises[0])), result(number, log.counts(mine, noises[1]))


def loss_of_points(points: float) -> float:
    """The fraction of right pixels that has to become wrong to lower the mean mIoU of logs by this many points."""
    rng = np.random.default_rng(1)
    logs = [SimulatedLog(rng) for _ in range(200)]

    def drop(loss: float) -> float:
        none = np.zeros((STRETCHES, CLASSES))
        both = [miou_of_counts(np.stack([log.counts(f, none).sum(axis=0) for f in (0.0, loss)])) for log in logs]
        return float(100 * np.mean([before - after for before, after in both]))

    low, high = 0.0, 0.5
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if drop(middle) < points else (low, middle)
    return low


def compared(results: Iterator[tuple[TaskResult, TaskResult]]) -> FleetComparison:
    """A fleet before and after, through stores in memory."""
    number = next(_NUMBERS)
    before, after = (Store(f"memory://{side}{number}", create=True) for side in "ab")
    for a, b in results:
        before.commit(a)
        after.commit(b)
    found = compare_stores(before, after)
    before.remove("results")
    after.remove("results")
    return found


def rates(fleets: int, logs: int, points: float, own_points: float, first_points: float) -> dict[str, float]:
    """Fractions of simulated fleets that are called worse, as a whole, by the mean and by single logs."""
    losses = [loss_of_points(p) if p else 0.0 for p in (points, own_points, first_points)]
    rng = np.random.default_rng(7)
    found = [compared(pairs(rng, logs, *losses)) for _ in range(fleets)]
    by_mean = np.mean([any("mean" in reason for reason in f.reasons) for f in found])
    by_logs = np.mean([f.count("worse") > 0 for f in found])
    named = np.mean([f.count("worse") for f in found]) / logs
    return {
        "worse": float(np.mean([bool(f.reasons) for f in found])),
        "by_mean": float(by_mean),
        "by_logs": float(by_logs),
        "logs_named": float(named),
    }


SCENARIOS = (  # what, loss of all logs, spread of each log's own, loss of the first log alone; points of mIoU
    ("a rerun with noise", 0.0, 0.0, 0.0),
    ("as good, each log 0.5 points better or worse", 0.0, 0.5, 0.0),
    ("all logs 0.5 points worse", 0.5, 0.5, 0.0),
    ("all logs 1 point worse", 1.0, 0.5, 0.0),
    ("all logs 2 points worse", 2.0, 0.5, 0.0),
    ("all logs 5 points worse", 5.0, 0.5, 0.0),
    ("one log 5 points worse", 0.0, 0.0, 5.0),
    ("one log 10 points worse", 0.0, 0.0, 10.0),
)


def main() -> None:
    """Simulate, and print a row for each case and number of logs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=200, help="simulated fleets for each row")
    parser.add_argument("--logs", type=int, nargs="+", default=[1, 5, 20, 100])
    parser.add_argument("--out", type=Path, help="also write the figures here, as JSON")
    options = parser.parse_args()
    rows = []
    print(f"{'case':46} {'logs':>5} {'worse':>7} {'by mean':>8} {'by logs':>8} {'logs named':>11}")
    for name, *points in SCENARIOS:
        for logs in options.logs:
            found = rates(options.fleets, logs, *points)
            rows.append({"case": name, "logs": logs, "fleets": options.fleets, **found})
            values = (found[key] for key in ("worse", "by_mean", "by_logs", "logs_named"))
            print(f"{name:46} {logs:5} " + " ".join(f"{100 * v:7.1f}%" for v in values), flush=True)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
