"""Where S-Ray's answer adds to a map that votes with each frame's own image: rules, each fused into a map of its own.

python -m research.experiments.vote_rules DIR val|test|kitchen|flat ...

DIR is that of ``kept_votes``. Votes are the geometric mean of the rendered view and what the own image says by itself,
with a weight of the latter that a rule chooses at each coarse pixel. Points of the map are scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from research.evaluation.bootstrap import paired_bootstrap
from research.experiments.kept_votes import Kept, fuse, load_all, true_points
from semantic_mapper.evaluation.metrics import ConfidenceScores, ConfusionMatrix
from semantic_mapper.imaging import FrameViews
from semantic_mapper.mapping.fusion import PROBABILITY_FLOOR
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Bool, Float32

Where = Callable[[Kept, VoxelMap], Bool]  # pixels (h, w) that another weight counts at


def votes(
    weight: float, where: Where | None = None, there: float = 0.2, of: str = "rendered"
) -> Callable[..., Float32]:
    """A rule: this weight of the own image, and ``there`` at some pixels; ``of`` which view it is against."""

    def rule(kept: Kept, voxel_map: VoxelMap) -> Float32:
        w = np.full(kept.known.shape, weight, np.float32)
        if where is not None:
            w[where(kept, voxel_map)] = there
        floor = np.log(np.float32(PROBABILITY_FLOOR))
        log_p = (1 - w)[..., None] * np.log(np.maximum(getattr(kept, of), PROBABILITY_FLOOR))
        log_p += w[..., None] * np.maximum(log_own(kept), floor)
        p = np.exp(log_p - log_p.max(axis=2, keepdims=True))
        return (p / p.sum(axis=2, keepdims=True)).astype(np.float32)

    return rule


def log_own(kept: Kept) -> Float32:
    """(h, w, L) log probabilities of the own image."""
    x = kept.own - kept.own.max(axis=2, keepdims=True)
    return x - np.log(np.exp(x).sum(axis=2, keepdims=True))


def _flat(below: float) -> Where:
    return lambda kept, _: log_own(kept).max(axis=2) < np.log(below)


def _unsure(below: float) -> Where:
    """Where the map so far has less confidence, or nothing yet."""
    return lambda kept, m: (
        m.ray_cast(kept.frame.T_world_camera, kept.coarse).confidence < below if m.block_count else kept.known
    )


def _beyond(least: float) -> Where:
    return lambda kept, _: FrameViews(kept.frame).depth(kept.coarse) > least


RULES = {
    "own image alone at every pixel (1)": votes(1),
    "own image + votes of the suite (0.2 of its own rendering)": votes(0.2, of="single"),
    **{f"S-Ray, weight {w}": votes(w) for w in (0.2, 0.5, 0.8, 0.9)},
    "1; 0.2 where the own image is flat (< 0.4)": votes(1, _flat(0.4)),
    "1; 0.2 where the map is unsure (< 0.5)": votes(1, _unsure(0.5)),
    "1; 0.5 beyond 3 m": votes(1, _beyond(3), 0.5),
}


def main() -> None:
    """Print a table a source."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sources", nargs="+")
    given = parser.parse_args()
    for source in given.sources:
        found: dict[str, list[ConfusionMatrix]] = {name: [] for name in RULES}
        sure = {name: ConfidenceScores() for name in RULES}
        for recording in load_all(given.folder, source):
            for name, rule in RULES.items():
                points = fuse(recording, rule)[0].points()
                truth, counts = true_points(recording, points)
                known = counts & (truth != recording.label_set.ignore_id)
                found[name].append(ConfusionMatrix(recording.label_set))
                found[name][-1].update(truth, points.label, recording.name)
                sure[name].update(points.confidence[known], (points.label == truth)[known], ~known[known])
        print(f"\n| {source}: weight of the own image | mIoU; ECE of points, % | over the first | over the second |")
        print("|---|---|---|---|")
        first, second = list(RULES)[:2]
        for name, of in found.items():
            total = sum(of[1:], of[0]).metrics().miou or 0.0
            cells = [f"{100 * total:.2f}; {100 * (sure[name].calibration_error or 0):.1f}"]
            for other in (first, second) if len(of) > 1 else ():
                d = paired_bootstrap(of, found[other])
                cells.append(f"{100 * d.observed:+.2f} ({100 * d.low:+.2f} to {100 * d.high:+.2f})")
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
