"""Records of two generators of rooms against each other: mIoU with intervals over rooms, and the classes that differ.

    semantic-mapper-research suite rooms --sources wide --out ROOMS.json    # and --map, --depth off
    semantic-mapper-research suite rooms --sources wide --config TURNED.toml --out TURNED.json
    python -m research.experiments.two_generators ROOMS.jsonl TURNED.jsonl

TURNED.toml holds ``[sequence]`` and ``style = "turned"``. Classes that one of the two lacks count in neither.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from research.evaluation.bootstrap import RESAMPLES, miou_of_counts
from research.suites.records import MapRecord, Record, RoomRecord, Rows
from semantic_mapper.evaluation.metrics import class_sums
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import Float64

_WHAT: dict[str, Callable[[Record], Rows | None]] = {
    "S-Ray": lambda r: r.confusion if isinstance(r, RoomRecord) else None,
    "own image": lambda r: r.rows["own"].confusion if isinstance(r, RoomRecord) else None,
    "points of the map": lambda r: r.confusion if isinstance(r, MapRecord) else None,
}


def compare(first: Sequence[Rows], second: Sequence[Rows], seed: int = 0) -> tuple[list[Float64], Float64]:
    """Confusions (L, L + 1) of rooms of two generators -> mIoU of both and their difference, each (3,): observed, 2.5
    and 97.5 % of resamples of the rooms; and IoU (2, L) of the classes that both have, NaN for others."""
    counts = [np.array(rooms, np.float64) for rooms in (first, second)]
    both = np.logical_and(*(c.sum(axis=(0, 2)) > 0 for c in counts))
    for c in counts:
        c[:, ~both] = 0  # truth of other classes is left out; answers of other classes are wrong
    rng, found = np.random.default_rng(seed), list[Float64]()
    for c in counts:
        times = rng.multinomial(len(c), np.full(len(c), 1 / len(c)), size=RESAMPLES)
        times[0] = 1
        found.append(miou_of_counts(np.einsum("bs,slc->blc", times, c, optimize=True)))
    found.append(found[1] - found[0])
    sums = [class_sums(c.sum(axis=0)) for c in counts]
    iou = np.stack([np.where(both, hits / np.maximum(union, 1), np.nan) for hits, _, union in sums])
    return [np.append(f[0], np.percentile(f[1:], (2.5, 97.5))) for f in found], iou


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs=2)
    files = [
        [msgspec.json.decode(line, type=Record) for line in path.read_bytes().splitlines()]
        for path in parser.parse_args().records
    ]
    print("| mIoU, % | first | second | second minus first (95 %) |\n|---|---|---|---|")
    for name, rows_of in _WHAT.items():
        first, second = ([rows for r in records if (rows := rows_of(r)) is not None] for records in files)
        if first and second:
            figures, iou = compare(first, second)
            cells = (f"{100 * f[0]:.1f} ({100 * f[1]:.1f} to {100 * f[2]:.1f})" for f in figures)
            print(f"| {name}, {len(first)} and {len(second)} rooms | {' | '.join(cells)} |")
            order = [int(c) for c in np.argsort(iou[1] - iou[0]) if np.isfinite(iou[0, c])]
            print("  ", ", ".join(f"{ROOMS.names[c]} {100 * iou[0, c]:.0f} > {100 * iou[1, c]:.0f}" for c in order))


if __name__ == "__main__":
    main()
