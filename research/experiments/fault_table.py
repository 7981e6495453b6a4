"""What came of each fault, as a table for people and as JSON."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one fault did.

    Args:
        case: Which fault, of what.
        back_s: From the fault (or from the moment that its cause is gone) until what it hit works again.
        lost_frames: Frames that were not published, not mapped or not answered for it.
        lost_messages: Messages that stand in no log.
        lost_blocks: Blocks of the last saved map that the map afterwards lacks.
        others: What else was touched: processes that are other ones now, wrong answers, changed maps.
        left: Processes that were left behind.
        counts: What was done and counted, for the case's note.
    """

    case: str
    back_s: float
    lost_frames: int = 0
    lost_messages: int = 0
    lost_blocks: int = 0
    others: int = 0
    left: int = 0
    counts: dict[str, int] = field(default_factory=dict[str, int])


def write(outcomes: Sequence[Outcome], target: Path, about: dict[str, str]) -> str:
    """``target``.json with every outcome, ``target``.md with one row a case; returns the table."""
    table = markdown(outcomes)
    target.parent.mkdir(parents=True, exist_ok=True)
    told = {"about": about, "outcomes": [asdict(o) for o in outcomes]}
    target.with_suffix(".json").write_text(json.dumps(told, indent=1), encoding="utf-8")
    lines = [f"{name}: {value}" for name, value in about.items()]
    target.with_suffix(".md").write_text("\n".join([*lines, "", table, ""]), encoding="utf-8")
    return table


def markdown(outcomes: Sequence[Outcome]) -> str:
    """One row a case: back after p50 / p95 / max, then the worst of what was lost or touched, then totals."""
    cases: defaultdict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        cases[outcome.case].append(outcome)
    rows = [
        "| fault | runs | back after, s: p50 / p95 / max | frames lost: p50 / max | log messages lost: max | "
        "saved blocks lost | others touched | left behind | counted, all runs |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for case, found in cases.items():
        back = sorted(o.back_s for o in found)
        frames = sorted(o.lost_frames for o in found)
        counts: defaultdict[str, int] = defaultdict(int)
        for outcome in found:
            for name, count in outcome.counts.items():
                counts[name] += count
        rows.append(
            f"| {case} | {len(found)} | {_rank(back, 0.5):.2f} / {_rank(back, 0.95):.2f} / {back[-1]:.2f} | "
            f"{_rank(frames, 0.5):.0f} / {frames[-1]} | {max(o.lost_messages for o in found)} | "
            f"{max(o.lost_blocks for o in found)} | {max(o.others for o in found)} | {max(o.left for o in found)} | "
            f"{', '.join(f'{count:,} {name}' for name, count in counts.items())} |"
        )
    return "\n".join(rows)


def _rank(ordered: Sequence[float], fraction: float) -> float:
    """The smallest value that so large a share does not exceed."""
    return ordered[max(0, math.ceil(fraction * len(ordered)) - 1)]
